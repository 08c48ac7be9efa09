"""Built-in stages; every marked function named here is found by the engine."""

from magtensor_stages.array import align as align
from magtensor_stages.array import assemble_tensor as assemble_tensor
from magtensor_stages.diurnal import detrend_diurnal as detrend_diurnal
from magtensor_stages.gradiometer import load_tensor as load_tensor
from magtensor_stages.joint import calibrate_joint as calibrate_joint
from magtensor_stages.load import load as load
from magtensor_stages.loop import close_loop as close_loop
from magtensor_stages.quality import qc as qc
from magtensor_stages.refine import refine_invariants as refine_invariants
from magtensor_stages.rotation import fix_rotation as fix_rotation
from magtensor_stages.sensors import calibrate_array as calibrate_array
from magtensor_stages.sensors import calibrate_scalar as calibrate_scalar
from magtensor_stages.sensors import calibrate_vector as calibrate_vector
