"""The speckle-stereo sensor in torch, with gradients."""
