"""High dynamic range -> pictures as screens and photos have them."""

from __future__ import annotations

from functools import cache

import numpy as np

PQ, HLG = 16, 18  # transfer characteristics by their numbers in ITU-T H.273

_WHITE = 203.0  # cd/m2 of white paper in both (ITU-R BT.2408)
_KNEE = 0.7  # of that: below it light is kept, above it squeezed
_BAND = 32  # rows at a time, which stay in the cache
_STEPS = 65535  # of the table that brings light to sRGB
_LUMA = np.array((0.2627, 0.6780, 0.0593), np.float32)  # of BT.2020
_REC709_FROM_2020 = np.array(  # ITU-R BT.2087
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)


def standard_range(picture: np.ndarray, transfer: int) -> np.ndarray:
    """Bring a BT.2020 picture of high dynamic range to sRGB.

    Signal to light (BT.2100), BT.2020's primaries to BT.709's, what is brighter than 0.7 of white paper squeezed
    so that nothing is clipped, and sRGB's curve.

    Args:
        picture: (H, W, 3) uint16 RGB signal, all 16 bits used.
        transfer: PQ or HLG.

    Returns:
        (H, W, 3) uint8.
    """
    shown = np.empty(picture.shape, np.uint8)
    for top in range(0, len(picture), _BAND):
        shown[top : top + _BAND] = _shown(picture[top : top + _BAND], transfer)
    return shown


def _shown(picture: np.ndarray, transfer: int) -> np.ndarray:
    light = _pq_light()[picture] if transfer == PQ else _hlg_light(picture)
    light = np.maximum(light.reshape(-1, 3) @ _REC709_FROM_2020.T, 0).reshape(picture.shape)
    brightest = light.max(axis=2)
    above = (np.maximum(brightest, _KNEE) - _KNEE) / (1 - _KNEE)
    light *= ((np.minimum(brightest, _KNEE) + (1 - _KNEE) * above / (1 + above)) / np.maximum(brightest, 1e-6))[
        ..., None
    ]
    return _srgb()[(light * _STEPS + 0.5).astype(np.uint16)]


@cache
def _pq_light() -> np.ndarray:
    """(65536,) float32 light of a signal, white paper's being 1 (SMPTE ST 2084)."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    root = (np.arange(65536) / 65535) ** (1 / m2)
    return (10000 / _WHITE * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)).astype(np.float32)


def _hlg_light(picture: np.ndarray) -> np.ndarray:
    """Light that a display of 1,000 cd/m2 makes of a picture, white paper's being 1 (ARIB STD-B67, gamma 1.2)."""
    scene = _hlg_scene()[picture]
    scene *= (1000 / _WHITE * np.maximum(scene @ _LUMA, 1e-6) ** 0.2)[..., None]
    return scene


@cache
def _hlg_scene() -> np.ndarray:
    """(65536,) float32 light in the scene of a signal, in [0, 1]."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    signal = np.arange(65536) / 65535
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12).astype(np.float32)


@cache
def _srgb() -> np.ndarray:
    """(_STEPS + 1,) uint8 level of light in [0, 1]."""
    light = np.arange(_STEPS + 1) / _STEPS
    return (255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055) + 0.5).astype(
        np.uint8
    )
