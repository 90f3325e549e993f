"""Import of volumes: readers, transfer functions, presets, scene folders and phantoms."""
