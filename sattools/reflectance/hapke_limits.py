"""Where the parameters of Hapke's model are held, as beyond them it or its derivatives are infinite."""

W_MAX = 1 - 1e-6
B_MAX = 0.999
THETA_MIN = 5e-5
THETA_MAX = 80.0

__all__ = ["B_MAX", "THETA_MAX", "THETA_MIN", "W_MAX"]
