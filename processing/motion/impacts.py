"""From which change of motion on something has hit the object: each user's threshold by name.

They differ because what they guard differs, and because each was set on its own; one law may take their place.
"""

from __future__ import annotations

EXTRAPOLATION_IMPACT_M_S, EXTRAPOLATION_IMPACT_RAD_S = 0.5, 5.0
"""A change of velocity and of spin from frame to frame beyond this is not carried on beyond the last frame."""
LATE_DEPTH_IMPACT_M_S = 0.35
"""A change of velocity around a frame beyond this: late depth is moved by the motion of the nearer side."""
DATA_CHECK_IMPACT_M_S = 0.3
"""A change of velocity that checks of a recording count as an impact (frames at 100 Hz and more)."""
FREE_M_S2 = 15.0
"""A body that is not hit accelerates by less than this (gravity, an arm)."""
