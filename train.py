"""Train a classifier: `python train.py experiment=qs3_s2d seed=0,1,2 -m`; see conf/experiment."""

from qs3.commands.train import main

if __name__ == "__main__":
    main()
