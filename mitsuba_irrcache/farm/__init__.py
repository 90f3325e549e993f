"""Rendering on many workers with ``dask.distributed`` (extra ``farm``)."""
