"""Numbers of physics and statistics that every package means alike."""

from __future__ import annotations

GRAVITY_M_S2 = 9.81
"""Acceleration of free fall: the conventional value to three digits (CGPM 1901: 9.80665; on earth 9.78 to 9.83)."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution per median absolute deviation: 1 / 0.6745 (Hampel 1974)."""
MAD_TO_SIGMA_SHORT = 1.48
"""The same to three digits, where masks and azimuths were tuned with it; one value when they are tuned anew."""
LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a pixel's luma (ITU-R BT.601)."""
