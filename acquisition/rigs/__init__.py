"""Rig files that come with tosslab: copy one and change it."""
