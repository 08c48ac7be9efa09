"""Built-in error models: the catalogue of docs/error_models.md."""

from magtensor_effects.ageing import (
    calibration_step,
    offset_drift,
    offset_step,
    offset_while,
    scale_drift,
    scale_step,
    warm_up,
)
from magtensor_effects.channels import channel_rate, channel_response, moving_part, periodic_interference
from magtensor_effects.geometry import baseline_expansion, finite_baseline, position_error
from magtensor_effects.inertia import (
    averaging,
    bandwidth,
    clock_drift,
    eddy_current,
    lag_step,
    sampling_lag,
    viscous_magnetisation,
)
from magtensor_effects.latent import latent_source
from magtensor_effects.mechanics import (
    alignment_drift,
    channel_alignment,
    crosstalk,
    frame_flexure,
    temperature_alignment,
    turn_step,
)
from magtensor_effects.power import current_field, supply_offset, supply_scale
from magtensor_effects.reference import (
    reference_clock,
    reference_drift,
    reference_scale,
    reference_step,
    reference_while,
)
from magtensor_effects.site import fixed_source, passing_source, site_gradient
from magtensor_effects.temperature import temperature_offset, temperature_rate, temperature_scale
from magtensor_effects.transfer import cross_field, hysteresis, nonlinearity_cubic, nonlinearity_quadratic

__all__ = [
    "alignment_drift",
    "averaging",
    "bandwidth",
    "baseline_expansion",
    "calibration_step",
    "channel_alignment",
    "channel_rate",
    "channel_response",
    "clock_drift",
    "cross_field",
    "crosstalk",
    "current_field",
    "eddy_current",
    "finite_baseline",
    "fixed_source",
    "frame_flexure",
    "hysteresis",
    "lag_step",
    "latent_source",
    "moving_part",
    "nonlinearity_cubic",
    "nonlinearity_quadratic",
    "offset_drift",
    "offset_step",
    "offset_while",
    "passing_source",
    "periodic_interference",
    "position_error",
    "reference_clock",
    "reference_drift",
    "reference_scale",
    "reference_step",
    "reference_while",
    "sampling_lag",
    "scale_drift",
    "scale_step",
    "site_gradient",
    "supply_offset",
    "supply_scale",
    "temperature_alignment",
    "temperature_offset",
    "temperature_rate",
    "temperature_scale",
    "turn_step",
    "viscous_magnetisation",
    "warm_up",
]
