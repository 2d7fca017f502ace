from recordings.system_libraries import load_unpacked, unpacked_folder

if unpacked_folder().is_dir():  # only where set-up could not install them
    load_unpacked(unpacked_folder())
