"""The fit on a CUDA device, with the extra `cuda` (cuda-core, cuda-bindings, NVRTC)."""
