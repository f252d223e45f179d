"""The formats that other programs read: how each is written, and what its numbers can hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from functools import partial

import numpy as np
from independent.clouds import BAND_0, EXACT, Differences

from hyrfpack.splats.formats import gltf, ply, sog, splat, spz
from hyrfpack.splats.formats.hints import Hints
from hyrfpack.splats.splats import Splats

UP = np.array([0.36, -0.8, 0.48])  # of the made-up cloud, for glTF and USD
BYTE = 0.5 / 255 * 1.01  # half a step, and float32


@dataclass(frozen=True)
class Format:
    """A way to write splats.

    Attributes:
        extension: of the file.
        encode: splats to bytes.
        precision: what the format's numbers allow, on the cloud of `clouds.made_up`.
        degrees: of harmonics that the format holds.
    """

    extension: str
    encode: Callable[[Splats], bytes]
    precision: Differences
    degrees: tuple[int, ...] = (0, 1, 2, 3)


# Colours and opacities are bytes, and quaternions too: 1/256 off in each of four numbers.
SPLAT = replace(EXACT, covariance=0.04, opacity=BYTE, color=BYTE, harmonic=BYTE / BAND_0)
# Positions of 12 bits behind the point, 16 steps of scale per factor e, quaternions of 10 bits. Others keep of a
# harmonic no more than the 4 upper bits of its byte; sixteen such errors add up in a colour.
SPZ = Differences(
    position=0.5 / 4096 * 1.01,
    deviation=1 / 32 * 1.01,
    covariance=np.expm1(1 / 16) + 0.002,
    opacity=BYTE,
    color=0.2,
    harmonic=1 / 15,
)
# We put as many bits behind the point as the scene has room for, and keep 5 or 6 of a harmonic's byte.
OUR_SPZ = replace(SPZ, position=1e-6, color=0.06, harmonic=1 / 63)
# Positions: 16 bits of the logarithm. Scales and colours: the 256 best values; ours are spread over three decades.
# Others cut the byte of an opacity off instead of rounding it.
SOG = Differences(position=1e-3, deviation=0.02, covariance=0.05, opacity=2 * BYTE, color=0.01, harmonic=0.01)
# Chunks of 256 Gaussians with 11 or 10 bits for each coordinate and scale, harmonics as bytes of [-4, 4].
COMPRESSED_PLY = Differences(position=0.01, deviation=0.005, covariance=0.02, opacity=0.002, color=0.05, harmonic=0.017)

LOOSEST = Differences(*np.max([astuple(precision) for precision in (SPLAT, SPZ, SOG, COMPRESSED_PLY)], axis=0))

FORMATS = {
    "ply": Format("ply", ply.encode, EXACT),
    "splat": Format("splat", splat.encode, SPLAT, degrees=(0,)),
    "spz3": Format("spz", partial(spz.encode, hints=Hints(spz_version=3)), OUR_SPZ),
    "spz4": Format("spz", partial(spz.encode, hints=Hints(spz_version=4)), OUR_SPZ),
    "sog": Format("sog", sog.encode, SOG),
    "glb": Format("glb", partial(gltf.encode, hints=Hints(UP)), EXACT),
}
