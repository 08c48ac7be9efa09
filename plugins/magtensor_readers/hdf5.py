"""HDF5 and netCDF-4."""

from __future__ import annotations

from pathlib import Path

from magtensor.components import reader
from magtensor.survey.tables import Tables


@reader(suffixes=(".h5", ".hdf5", ".hdf", ".nc", ".nc4", ".he5", ".mat"))
def hdf5(paths: list[Path]) -> Tables:
    """Any HDF5 file by dataset path: netCDF-4, plain h5py, MATLAB 7.3, with or without dimension scales.

    Fill values become NaN; scale_factor and add_offset are applied; the fields of compound datasets are columns
    of their own (`table/field`). Files that follow each other are joined along the first dimension.
    """
    from magtensor.survey.hdf5 import read_hdf5

    return read_hdf5(paths)
