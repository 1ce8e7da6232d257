"""How long tests wait."""

HANGING_S = 900.0  # for a program that hangs; no test asks how fast one is, as the machine may be slow or shared
