"""Simulated sessions of another kind than the packages' own: developers' programs, never imported by the packages."""
