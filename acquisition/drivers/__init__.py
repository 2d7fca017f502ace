"""One file per device: the vendor's client behind the protocols of `acquisition.devices`, imported when chosen."""
