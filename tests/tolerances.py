"""Tolerances, argued once."""

# float32 holds seven digits; sums over some hundred thousand terms cost two of them
FLOAT32 = 1e-5
# a corner snapped to 1/256 px moves an edge by at most this, per axis
SNAP_PX = 0.5 / 256
# central differences in float64 with a step of 1e-4 on quantities near 1
FINITE_DIFFERENCE = 1e-6
# an 8-bit code value
CODE = 1 / 255
# code values of a table of light in 2^18 steps, half a step off where the curve is steepest, 12.92; and float32
BY_TABLE = 12.92 / 2**19 + FLOAT32
