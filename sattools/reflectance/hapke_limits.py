"""All constants of Hapke's model: where its parameters are held, and what keeps quotients and exponents finite."""

import math

W_MAX = 1 - 1e-6
B_MAX = 0.999
THETA_MIN = 5e-5
THETA_MAX = 80.0

# exponents end here: exp(-60) = 9e-27 is 0 beside anything it is added to, and denormal numbers would be slow
EXPONENT_MAX = 60.0
U_MAX = EXPONENT_MAX * math.pi / 2
# sin^2 and |projections|^2 below these leave no weight to the azimuth (E1 and E2 at their least);
# they only keep quotients finite
SIN2_MIN = 1e-12
R2_MIN = 1e-24
# both vanish only at i = e = 90 degrees, psi = 180 degrees, where the effective cosines go to 0 with them
D_MIN = 1e-7
A_MIN = 1e-12
T_MAX = EXPONENT_MAX / 2
# lit and seen along its own plane from one side (i = e = 90 degrees, psi = 0) a facet has an infinite BRF: pi L / (E
# cos i)
Z_MIN = 1e-6

__all__ = [
    "A_MIN", "B_MAX", "D_MIN", "EXPONENT_MAX", "R2_MIN", "SIN2_MIN", "THETA_MAX", "THETA_MIN", "T_MAX", "U_MAX",
    "W_MAX", "Z_MIN",
]  # fmt: skip
