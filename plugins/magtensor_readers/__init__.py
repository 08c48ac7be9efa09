"""The built-in readers: HDF5, text, IAGA-2002, NASA CDF."""

from magtensor_readers.cdf import cdf
from magtensor_readers.hdf5 import hdf5
from magtensor_readers.iaga2002 import iaga2002
from magtensor_readers.text import text

__all__ = ["cdf", "hdf5", "iaga2002", "text"]
