"""Cross-correlation of many pairs of small binary images at once, as exact integer counts.

The images hold zeros and ones, so every correlation value is a count. Whatever computes it, the nearest integer is the
result; engines, devices and batch sizes then agree to the last bit.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# Rounding is safe while the error of a float32 FFT stays below 1/2. Its error is at most about
# eps * log2(points) * |template| * |target|; the factor is a margin on top.
_FFT_ERROR_MARGIN = 8.0
_FFT_LARGEST_ERROR = 0.25
# Lengths that FFT libraries are fast at, in steps of at most a quarter, most of them an eighth.
FAST_LENGTHS = tuple(sorted(n << k for k in range(14) for n in (8, 9, 10, 12, 15, 21, 22, 25, 27, 28)))


def cross_correlate(
    images: Tensor, num_templates: int, own: Tensor, engine: str = "fft", most: int | None = None
) -> Tensor:
    """Number of coinciding pixels for shifts of templates over targets (numerator of Eq. norm_correlation).

    Args:
        images: (J + N, Y, X) float32 zeros and ones: J templates, then N targets.
        num_templates: J.
        own: (J,) int64, target of each template; a target's spectrum serves all its templates.
        engine: "fft" or "conv" (conv2d).
        most: no image has more ones; None = it is not known, and large images are counted.

    Returns:
        (J, Y, X) float, less than 1/2 away from the sum over p of template[j](p) * target(p + (y, x)): round it.

    Convention:
        "fft" wraps around: p + (y, x) is taken modulo (Y, X). "conv" does not. Callers read only shifts where nothing
        wraps.

    Cost: "fft" Y X log(Y X) per template and target; "conv" (Y X)^2 per template.
    """
    if engine == "conv":
        return _by_conv(images, num_templates, own)
    images = images.to(_fft_dtype(images, most))
    height, width = images.shape[-2:]
    spectrum = torch.fft.rfft(images[..., 0, :]) if height == 1 else torch.fft.rfft2(images)
    product = spectrum[num_templates:].index_select(0, own).mul_(spectrum[:num_templates].conj())
    if height == 1:
        return torch.fft.irfft(product, n=width)[:, None]
    return torch.fft.irfft2(product, s=(height, width))


def _fft_dtype(images: Tensor, most: int | None) -> torch.dtype:
    # The number of samples bounds the norms without looking at the images (no synchronisation).
    samples = math.prod(images.shape[1:])
    error = _FFT_ERROR_MARGIN * torch.finfo(torch.float32).eps * math.log2(samples)
    if error * samples > _FFT_LARGEST_ERROR:
        samples = int(images.flatten(1).sum(1).max()) if most is None else most
    return torch.float32 if error * samples <= _FFT_LARGEST_ERROR else torch.float64


def _by_conv(images: Tensor, num_templates: int, own: Tensor) -> Tensor:
    height, width = (images.amax(0).nonzero().amax(0) + 1).tolist()  # the rest of all images is empty
    templates, targets = images[:num_templates, :height, :width], images[num_templates:, :height, :width]
    padded = F.pad(targets, (0, width - 1, 0, height - 1)).index_select(0, own)
    # One group per template. Sums of products of zeros and ones are exact in float32 up to 2^24, also with TF32.
    counts = F.conv2d(padded[None], templates[:, None], groups=num_templates)[0]
    return F.pad(counts, (0, images.shape[2] - width, 0, images.shape[1] - height))
