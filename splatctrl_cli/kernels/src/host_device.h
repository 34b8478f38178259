// Marks what the processor's compiler and the card's both compile.
#pragma once

#if defined(__CUDACC__)
#define SPLATCTRL_HOST_DEVICE __host__ __device__
#else
#define SPLATCTRL_HOST_DEVICE
#endif
