"""The published methods, built in as plugins."""

from magtensor_methods.chi2017 import chi2017 as chi2017
from magtensor_methods.chi2017 import procrustes as procrustes
from magtensor_methods.determined import determined_only as determined_only
from magtensor_methods.li2018 import li2018 as li2018
from magtensor_methods.li2018 import li2018_linear as li2018_linear
from magtensor_methods.li2018 import li2018_lm as li2018_lm
from magtensor_methods.linear_regression import linear_regression as linear_regression
from magtensor_methods.orbit_likelihood import orbit_likelihood as orbit_likelihood
from magtensor_methods.pang2013 import pang2013 as pang2013
from magtensor_methods.sui2017 import sui2017 as sui2017
from magtensor_methods.tensor_cross import chi2017_cross as chi2017_cross
from magtensor_methods.tensor_cross import li2018_cross as li2018_cross
from magtensor_methods.tensor_least_squares import least_squares as least_squares
from magtensor_methods.yin2014 import yin2014 as yin2014
from magtensor_methods.yin2014 import yin2014_linear as yin2014_linear
from magtensor_methods.yin2015 import eigen_square_root as eigen_square_root
from magtensor_methods.zhang2015 import zhang2015 as zhang2015
