"""List the formats that other programs read, with the encoder and the precision of each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from functools import partial

import numpy as np
from independent.clouds import BAND_0_VALUE, FLOAT32_PRECISION, Differences

from hyrfpack.splats.formats import gltf, ply, sog, splat, spz
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats

UP_DIRECTION = np.array([0.36, -0.8, 0.48])
MAX_BYTE_ERROR = 0.5 / 255 * 1.01  # half a step of a byte, plus 1 % for float32 rounding


@dataclass(frozen=True)
class Format:
    """A splat format with its encoder and precision.

    Attributes:
        extension: file extension without the dot.
        encode: function that turns splats into the bytes of a file.
        precision: largest differences that the format's numbers cause on the splats of `clouds.sample_splats`.
        degrees: degrees of harmonics that the format can hold.
    """

    extension: str
    encode: Callable[[Splats], bytes]
    precision: Differences
    degrees: tuple[int, ...] = (0, 1, 2, 3)


# Colours, opacities and quaternions are bytes; each of the four numbers of a quaternion is off by up to 1/256.
SPLAT_PRECISION = replace(
    FLOAT32_PRECISION,
    covariance=0.04,
    opacity=MAX_BYTE_ERROR,
    color=MAX_BYTE_ERROR,
    harmonic=MAX_BYTE_ERROR / BAND_0_VALUE,
)
# Positions have 12 fractional bits, scales 16 steps per factor e, quaternions 10 bits. Other programs keep only the
# 4 upper bits of a harmonic's byte; sixteen such errors add up in a colour.
SPZ_PRECISION = Differences(
    position=0.5 / 4096 * 1.01,
    deviation=1 / 32 * 1.01,
    covariance=np.expm1(1 / 16) + 0.002,
    opacity=MAX_BYTE_ERROR,
    color=0.2,
    harmonic=1 / 15,
)
# Our encoder uses as many fractional bits as the extent of the scene allows, and keeps 5 or 6 bits of a harmonic.
OUR_SPZ_PRECISION = replace(SPZ_PRECISION, position=1e-6, color=0.06, harmonic=1 / 63)
# Positions have 16 bits of their logarithm. Scales and colours use the 256 best values; the test splats' scales span
# three decades. Other programs truncate the byte of an opacity instead of rounding it.
SOG_PRECISION = Differences(
    position=1e-3, deviation=0.02, covariance=0.05, opacity=2 * MAX_BYTE_ERROR, color=0.01, harmonic=0.01
)
# Chunks of 256 Gaussians have 11 or 10 bits for each coordinate and scale; harmonics are bytes that span [-4, 4].
COMPRESSED_PLY_PRECISION = Differences(
    position=0.01, deviation=0.005, covariance=0.02, opacity=0.002, color=0.05, harmonic=0.017
)

LOOSEST_PRECISION = Differences(
    *np.max(
        [astuple(precision) for precision in (SPLAT_PRECISION, SPZ_PRECISION, SOG_PRECISION, COMPRESSED_PLY_PRECISION)],
        axis=0,
    )
)

SPLAT_FORMATS = {
    "ply": Format("ply", ply.encode, FLOAT32_PRECISION),
    "splat": Format("splat", splat.encode, SPLAT_PRECISION, degrees=(0,)),
    "spz3": Format("spz", partial(spz.encode, hints=Hints(spz_version=3)), OUR_SPZ_PRECISION),
    "spz4": Format("spz", partial(spz.encode, hints=Hints(spz_version=4)), OUR_SPZ_PRECISION),
    "sog": Format("sog", sog.encode, SOG_PRECISION),
    "glb": Format("glb", partial(gltf.encode, hints=Hints(UP_DIRECTION)), FLOAT32_PRECISION),
}
