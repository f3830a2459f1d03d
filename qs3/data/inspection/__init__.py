"""What a dataset is like, measured: one domain, or two beside each other.

`python -m qs3.data.inspect` is its command. `facts` gives plain values, `words` makes text of them.
"""
