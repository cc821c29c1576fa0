"""How far two methods found the same flow."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Dict, Optional, Sequence

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.types import FlowResult

# Flows closer than this are the same: shifts are whole pixels, so different ones are a pixel (centimetres) apart, and
# float32 rounding of a flow is below 1e-6 m.
_SAME_FLOW_M = 1e-5


def share_agreement(flows: Sequence[FlowResult], others: Sequence[FlowResult], config: Config) -> Dict[str, Any]:
    """Share of the valid points with the same residual flow, and with one at most a (coarsest) pixel per axis away."""
    valid = torch.cat([flow.is_valid.cpu() for flow in flows])
    pairs = zip(flows, others)
    distance = torch.cat([(a.residual_flow.cpu() - b.residual_flow).abs().amax(1) for a, b in pairs])[valid]
    share = [float((distance <= limit + _SAME_FLOW_M).double().mean()) for limit in (0.0, config.pixel_sizes[0])]
    share = share if len(distance) else [1.0, 1.0]
    return {"same_flow": share[0], "within_one_pixel": share[1], "points": len(distance)}


def same_bits(flows: Sequence[FlowResult], others: Sequence[FlowResult]) -> Dict[str, bool]:
    """For each field of the result, whether it is equal everywhere, and whether all are."""
    names = [field.name for field in fields(FlowResult)]
    pairs = list(zip(flows, others))
    same = {n: all(_is_same(getattr(a, n), getattr(b, n)) for a, b in pairs) for n in names}
    return {"bit_equal": all(same.values()), **same}


def _is_same(one: Optional[Tensor], other: Optional[Tensor]) -> bool:
    return one is other if one is None or other is None else torch.equal(one.cpu(), other.cpu())
