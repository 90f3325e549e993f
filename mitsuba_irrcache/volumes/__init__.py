"""Getting volumes in: readers, transfer functions, presets, scene folders and phantoms."""
