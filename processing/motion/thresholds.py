"""Held, in flight, hit, at rest: from which numbers on each user of a motion says so, side by side by name.

`phases.py` gives a whole toss its phases, once its track is finished; it needs no threshold on a speed, but a cost per
segment. The numbers here are asked before that, or of two or three frames alone. They differ because what they guard
differs, and because each was set on its own data; one law may take their place. Elsewhere stay:

- `sensor/still.py`, `sensor/view_store.py` (STILL_*): whether images changed, in grey levels and pixels,
  before any pose;
- `segment/detect/`, `track/flight.py`: whether a thing without a pose falls, in metres of what is seen of it;
- `track/joint_refinement.py`, `smoother.py` (FLIGHT_CHANGE_*, also of the forecasts): standard deviations of
  residuals, no decisions;
- `track/registration/support_plane.py`: how far what stands still seems to move between keyframes, in metres;
- `motion_prior.py`: where a smooth cost saturates;
- `acquisition/detect.py`: the live watcher, from thumbnails of depth and the gripper's width.
"""

from __future__ import annotations

# hit

EXTRAPOLATION_IMPACT_M_S, EXTRAPOLATION_IMPACT_RAD_S = 0.5, 5.0
"""A change of velocity and of spin from frame to frame beyond this is not carried on beyond the last frame."""
LATE_DEPTH_IMPACT_M_S = 0.35
"""A change of velocity around a frame beyond this: late depth is moved by the motion of the nearer side."""
DATA_CHECK_IMPACT_M_S = 0.3
"""A change of velocity that checks of a recording count as an impact (frames at 100 Hz and more)."""
UNEXPLAINED_IMPACT_M_S = 0.35
"""A change of velocity that no impulse from the plane explains and that is less than this may be the track's noise."""
FREE_M_S2 = 15.0
"""A body that is not hit accelerates by less than this (gravity, an arm)."""

# in flight

AZIMUTH_FLIGHT_M_S = 0.15
"""A change of velocity from frame to frame, beyond gravity's, below this is free flight of a round body, whose azimuth
is not known yet."""

# at rest

LEAST_REST_SIGMA_M, LEAST_REST_SIGMA_RAD = 3e-4, 5e-3
"""No pose of a body at rest is steadier than this (the tracker's own creep); segments of rest are fitted with it."""
MOVING_M_S = 0.1
"""A speed from frame to frame above this counts as motion where a toss's usual speed is named to the user."""

# held

CARRIED_AXIS_RAD, CARRIED_AXIS_M = 0.05, 0.006
"""From view to view, an axis that moves as the robot's hand does within these is carried by it."""
