"""Cross-correlation of many pairs of small binary images at once, as exact integer counts.

The images hold zeros and ones, so every correlation value is a count. Whatever computes it, the nearest integer is the
result; engines, devices and batch sizes then agree to the last bit.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

# Rounding is safe while the error of a float32 FFT stays below 1/2. Its error is at most about
# eps * log2(points) * |template| * |target|; the factor is a margin on top.
_FFT_ERROR_MARGIN = 8.0
_FFT_LARGEST_ERROR = 0.25
_SHORT_FFT = 64


def cross_correlate(
    images: Tensor, num_templates: int, target_of_job: Tensor, engine: str = "fft"
) -> Tuple[Tensor, Tensor, Tensor]:
    """Number of coinciding pixels for every shift of a template over a target (numerator of Eq. norm_correlation).

    Args:
        images: (J + N, H, W) float32 zeros and ones: J templates, then N targets.
        num_templates: J.
        target_of_job: (J,) int64, target of each template; a target's spectrum serves all its templates.
        engine: "fft" or "conv" (conv2d).

    Returns:
        counts: (J, Y, X) float, less than 1/2 away from the sum over p of template[j](p) * target(p + (dy, dx)), zero
            outside the images: round it. All shifts |dy| <= H // 2, |dx| <= W // 2 are there; others mean nothing.
        dy: (Y,) int64, vertical shift of each row of `counts`.
        dx: (X,) int64, horizontal shift of each column.

    Cost: "fft" H W log(H W) per template and target; "conv" (H W)^2 per template.
    """
    return (
        _by_fft(images, num_templates, target_of_job)
        if engine == "fft"
        else _by_conv(images, num_templates, target_of_job)
    )


@lru_cache(maxsize=None)
def fft_length(size: int) -> int:
    """Transform length for images of `size` pixels and shifts of up to size // 2: factors 2, 3 and 5 only.

    Shifts of up to size // 2 need size + size // 2 samples: what wraps around lands beyond them. Long transforms are
    multiples of 8: two rows of 640 samples take half the time of two of 625.
    """
    length = size + size // 2
    while _odd_part(length) != 1 or (length > _SHORT_FFT and length % 8):
        length += 1
    return length


def _by_fft(images: Tensor, num_templates: int, target_of_job: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    shape = (fft_length(images.shape[1]), fft_length(images.shape[2]))
    spectrum = torch.fft.rfft2(images.to(_fft_dtype(images, shape)), s=shape)
    of_template, of_target = spectrum[:num_templates], spectrum[num_templates:]
    counts = torch.fft.irfft2(of_target.index_select(0, target_of_job) * of_template.conj(), s=shape)
    return counts, _wrapped_shifts(shape[0], counts.device), _wrapped_shifts(shape[1], counts.device)


@lru_cache(maxsize=None)
def _wrapped_shifts(length: int, device: torch.device) -> Tensor:
    """Shift of each sample of a correlation by FFT: those below zero stand at the end."""
    shift = torch.arange(length, device=device)
    return torch.where(shift > length // 2, shift - length, shift)


def _fft_dtype(images: Tensor, shape: Tuple[int, int]) -> torch.dtype:
    # The number of pixels bounds the norms without looking at the images (no synchronisation).
    pixels = images.shape[1] * images.shape[2]
    error = _FFT_ERROR_MARGIN * torch.finfo(torch.float32).eps * math.log2(shape[0] * shape[1])
    if error * pixels <= _FFT_LARGEST_ERROR:
        return torch.float32
    largest = float(images.sum((1, 2)).max()) if len(images) else 0.0
    return torch.float32 if error * largest <= _FFT_LARGEST_ERROR else torch.float64


def _by_conv(images: Tensor, num_templates: int, target_of_job: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    height, width = images.shape[1:]
    pad = (width // 2, width // 2, height // 2, height // 2)
    padded = F.pad(images[num_templates:], pad)[target_of_job]
    # One group per template. Sums of products of zeros and ones: exact in float32 up to 2^24, also with TF32.
    counts = F.conv2d(padded[None], images[:num_templates, None], groups=num_templates)[0]
    dy, dx = (torch.arange(-(n // 2), n // 2 + 1, device=counts.device) for n in (height, width))
    return counts, dy, dx


def _odd_part(number: int) -> int:
    for prime in (2, 3, 5):
        while number % prime == 0:
            number //= prime
    return number
