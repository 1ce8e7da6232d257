"""How numerical kernels are compiled."""

# What may be assumed of numbers. Sums must not be reordered and products not fused: the compiler would do so
# in one way when a kernel is compiled and used at once and in another when it comes from the cache, and the first run
# after an installation would give other heights than the second. Kernels that meet NaN or infinity must not use these.
FASTMATH = {"nnan", "ninf", "nsz"}

__all__ = ["FASTMATH"]
