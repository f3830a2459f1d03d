"""What a dataset is like, measured: one domain, or two beside each other.

`qs3 inspect` is its command. `facts` gives plain values, `words` makes text of them.
"""
