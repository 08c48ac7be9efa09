"""The rotation between the common frame of calibrated sensors and the platform: what tells it, and how well.

Scalar calibration leaves one rotation of the whole array free. A uniform field does not show it; the tensor in a
gradient is wrong by it. Here P is the rotation that takes the calibrated field into the platform's frame, where the
sensors' positions are known: b_platform = P b. Each source of knowledge about P is a sum over samples that depends
on moments only, so that a record is read once; several sources add up.
"""
