"""Sessions of the simulated lab as folders, its presets, and what only benchmarks draw: developers' programs."""
