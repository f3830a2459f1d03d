"""Train a classifier: `python train.py experiment=qs3_s2d seed=0,1,2 -m`; see conf/experiment."""

from pathlib import Path

from qs3.utils.environment import needs_packages

with needs_packages(Path(__file__).parent):
    from qs3.commands.train import main

if __name__ == "__main__":
    main()
