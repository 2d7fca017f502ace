"""The order of the stages: the only room that calls them. `process` is the whole of it on one screen."""
