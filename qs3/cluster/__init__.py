"""Tasks on several machines: Ray's clusters and SLURM's arrays, in the form of `qs3.utils.pool`."""
