"""qs3: from CAD meshes to a classifier that works on real depth scans.

Implements QS3 (Chen et al., "Quasi-Balanced Self-Training on Noise-Aware Synthesis of
Object Point Clouds", ECCV 2022). Importing this package imports nothing heavy.
"""

__version__ = "0.1.0"
