from pathlib import Path

from recordings.system_libraries import load_unpacked, place_kernel_cache, unpacked_folder

place_kernel_cache(Path(__file__).parent)
if unpacked_folder().is_dir():  # only where set-up could not install them
    load_unpacked(unpacked_folder())
