
from magtensor_stages.load import load as load
