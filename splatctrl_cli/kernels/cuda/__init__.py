"""The fit on a CUDA device, by the extra `cuda` (cuda-core, cuda-bindings, NVRTC)."""
