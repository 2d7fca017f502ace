"""Contact dynamics from poses: shape, friction and inertia of one tossed body on a plane (ContactNets)."""
