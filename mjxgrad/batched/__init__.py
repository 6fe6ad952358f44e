"""Arrays of many states, in the way that suits the device: layouts, sums, small factorisations, kernels of a GPU. No physics."""

from mjxgrad.batched.device import over_devices

__all__ = ["over_devices"]
