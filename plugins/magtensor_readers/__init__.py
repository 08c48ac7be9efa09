"""The built-in readers: HDF5, text, IAGA-2002, NASA CDF."""

from magtensor_readers.hdf5 import hdf5

__all__ = ["hdf5"]
