"""Cross-correlation of many pairs of small binary images at once, as exact integer counts.

The images consist of zeros and ones, so every correlation value is a count. We round it to the nearest integer, so
engines, devices and batch sizes agree to the last bit.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# Rounding is safe while the error of a float32 FFT is below 1/2. This error is at most about
# eps * log2(points) * |template| * |target|, which we multiply by a margin.
_FFT_ERROR_MARGIN = 8.0
_FFT_LARGEST_ERROR = 0.25
# Lengths for which FFT libraries are fast. Each is at most a quarter above the one before, most are about an eighth.
FAST_LENGTHS = tuple(sorted(n << k for k in range(14) for n in (8, 9, 10, 12, 15, 21, 22, 25, 27, 28)))


def cross_correlate(
    images: Tensor, num_templates: int, target: Tensor, engine: str = "fft", most: int | None = None
) -> Tensor:
    """Count the coinciding pixels for all shifts of templates over targets (numerator of Eq. norm_correlation).

    Args:
        images: (J + N, Y, X) bool: J templates, then N targets.
        num_templates: J.
        target: (J,) int64, target of each template. The spectrum of a target serves all its templates.
        engine: "fft" or "conv" (conv2d).
        most: upper bound of the number of ones in an image, for the precision of large FFTs; None = we count them.

    Returns:
        (J, Y, X) float, within 1/2 of the sum over p of template[j](p) * target(p + (y, x)). The caller rounds it.

    Convention:
        "fft" wraps around (p + (y, x) modulo (Y, X)), "conv" does not. Callers read only shifts that do not wrap.

    Cost: "fft" Y X log(Y X) per template and target; "conv" (Y X)^2 per template.
    """
    # From bytes, because on the CPU torch converts bools five times more slowly.
    as_bytes = images.view(torch.uint8)
    if engine == "conv":
        return _by_conv(as_bytes.float(), num_templates, target)
    numbers = as_bytes.to(_fft_dtype(images, most))
    height, width = images.shape[-2:]
    spectrum = torch.fft.rfft(numbers[:, 0]) if height == 1 else torch.fft.rfft2(numbers)
    # In place, because a lazy `conj` would be copied by the product.
    templates = spectrum[:num_templates].conj_physical_()
    product = spectrum[num_templates:].index_select(0, target).mul_(templates)
    if height == 1:
        return torch.fft.irfft(product, n=width)[:, None]
    return torch.fft.irfft2(product, s=(height, width))


def _fft_dtype(images: Tensor, most: int | None) -> torch.dtype:
    # The number of samples bounds the number of ones without a synchronisation.
    samples = math.prod(images.shape[1:])
    error = _FFT_ERROR_MARGIN * torch.finfo(torch.float32).eps * math.log2(samples)
    if error * samples > _FFT_LARGEST_ERROR:
        samples = int(images.flatten(1).sum(1).max()) if most is None else most
    return torch.float32 if error * samples <= _FFT_LARGEST_ERROR else torch.float64


def _by_conv(images: Tensor, num_templates: int, target: Tensor) -> Tensor:
    height, width = (images.amax(0).nonzero().amax(0) + 1).tolist()  # the rest is empty in all images
    templates = images[:num_templates, :height, :width]
    targets = images[num_templates:, :height, :width]
    padded = F.pad(targets, (0, width - 1, 0, height - 1)).index_select(0, target)
    # One group per template. Sums of products of zeros and ones are exact in float32 up to 2^24, also with TF32.
    counts = F.conv2d(padded[None], templates[:, None], groups=num_templates)[0]
    return F.pad(counts, (0, images.shape[2] - width, 0, images.shape[1] - height))
