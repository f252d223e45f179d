"""Tone map pictures of high dynamic range (PQ and HLG) to sRGB."""

from __future__ import annotations

from functools import cache

import numpy as np

# Numbers of transfer characteristics in ITU-T H.273.
PQ_TRANSFER = 16
HLG_TRANSFER = 18

_REFERENCE_WHITE_CD_M2 = 203.0  # diffuse white of PQ and HLG pictures according to ITU-R BT.2408
_KNEE_WHITE_RATIO = 0.7  # light above this ratio of the reference white is compressed, light below it is kept
_ROWS_PER_BAND = 32  # a band of this height stays in the processor's cache
_SRGB_TABLE_STEPS = 65535
_BT2020_LUMA_WEIGHTS = np.array((0.2627, 0.6780, 0.0593), np.float32)
_BT709_FROM_BT2020 = np.array(  # matrix of ITU-R BT.2087
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)


def tone_map_to_srgb(picture: np.ndarray, transfer: int) -> np.ndarray:
    """Convert a BT.2020 picture of high dynamic range to sRGB.

    The steps are: signal to linear light (BT.2100), BT.2020 primaries to BT.709 primaries, compression of bright light,
    and the sRGB transfer curve. Light above 0.7 of the reference white is compressed, so that nothing is clipped.

    Args:
        picture: (H, W, 3) uint16 RGB signal that uses all 16 bits.
        transfer: PQ_TRANSFER or HLG_TRANSFER.

    Returns:
        (H, W, 3) uint8 sRGB picture.
    """
    mapped = np.empty(picture.shape, np.uint8)
    for top in range(0, len(picture), _ROWS_PER_BAND):
        mapped[top : top + _ROWS_PER_BAND] = _tone_map_band(picture[top : top + _ROWS_PER_BAND], transfer)
    return mapped


def _tone_map_band(picture: np.ndarray, transfer: int) -> np.ndarray:
    """Tone map a few rows of a picture: (H, W, 3) uint16 to uint8."""
    light = _pq_light_table()[picture] if transfer == PQ_TRANSFER else _decode_hlg_light(picture)
    light = np.maximum(light.reshape(-1, 3) @ _BT709_FROM_BT2020.T, 0).reshape(picture.shape)
    brightest = light.max(axis=2)
    above = (np.maximum(brightest, _KNEE_WHITE_RATIO) - _KNEE_WHITE_RATIO) / (1 - _KNEE_WHITE_RATIO)
    light *= (
        (np.minimum(brightest, _KNEE_WHITE_RATIO) + (1 - _KNEE_WHITE_RATIO) * above / (1 + above))
        / np.maximum(brightest, 1e-6)
    )[..., None]
    return _srgb_table()[(light * _SRGB_TABLE_STEPS + 0.5).astype(np.uint16)]


@cache
def _pq_light_table() -> np.ndarray:
    """Return the light of each 16-bit PQ signal, relative to the reference white (SMPTE ST 2084): (65536,) float32."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    root = (np.arange(65536) / 65535) ** (1 / m2)
    return (10000 / _REFERENCE_WHITE_CD_M2 * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)).astype(
        np.float32
    )


def _decode_hlg_light(picture: np.ndarray) -> np.ndarray:
    """Return the light on a display of 1,000 cd/m2, relative to the reference white (ARIB STD-B67, gamma 1.2)."""
    scene = _hlg_scene_light_table()[picture]
    scene *= (1000 / _REFERENCE_WHITE_CD_M2 * np.maximum(scene @ _BT2020_LUMA_WEIGHTS, 1e-6) ** 0.2)[..., None]
    return scene


@cache
def _hlg_scene_light_table() -> np.ndarray:
    """Return the scene light in [0, 1] of each 16-bit HLG signal: (65536,) float32."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    signal = np.arange(65536) / 65535
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12).astype(np.float32)


@cache
def _srgb_table() -> np.ndarray:
    """Return the sRGB levels of equally spaced linear light in [0, 1]: (_SRGB_TABLE_STEPS + 1,) uint8."""
    light = np.arange(_SRGB_TABLE_STEPS + 1) / _SRGB_TABLE_STEPS
    return (255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055) + 0.5).astype(
        np.uint8
    )
