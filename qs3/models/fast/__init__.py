"""Kernels derived from the layers of the nets: the same sums, faster and in less memory."""
