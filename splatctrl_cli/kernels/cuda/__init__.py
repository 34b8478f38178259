"""The fit on a CUDA device. Optional: the extra `cuda` (cuda-core, cuda-bindings, NVRTC); imports nothing of ours
beyond `kernels`.
"""
