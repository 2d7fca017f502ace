"""The simulated lab: one scene generator for the synthetic driver, the samples and the variety to tune vision on."""
