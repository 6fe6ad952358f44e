"""Arrays of many states: memory layouts, sums, small factorisations and GPU kernels, chosen per device. No physics."""

from mjxgrad.batched.device import over_devices
