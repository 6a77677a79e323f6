"""Poses and ports that were found, in words and for JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from viskill_deploy.calibrate.port import Port
from viskill_deploy.calibrate.pose_fit import PoseFit
from viskill_deploy.calibrate.seen_poses import PoseMean


def pose_facts(fit: PoseFit) -> dict[str, Any]:
    """A pose for JSON."""
    held_out = fit.held_out_m[np.isfinite(fit.held_out_m)]
    return {
        "T_task": fit.T.tolist(),
        "sigma": np.sqrt(np.diag(fit.covariance)).tolist(),
        "points": len(fit.is_inlier),
        "left_out": np.flatnonzero(~fit.is_inlier).tolist(),
        "held_out_median_m": float(np.median(held_out)) if len(held_out) else None,
    }


def pose_words(fit: PoseFit) -> str:
    """A pose for people."""
    sigma = np.sqrt(np.diag(fit.covariance))
    held_out = fit.held_out_m[np.isfinite(fit.held_out_m)]
    seen = f"; points not seen: median {1e3 * np.median(held_out):.2f} mm" if len(held_out) else ""
    left_out = np.flatnonzero(~fit.is_inlier) + 1
    wrong = f"; left out: {', '.join(map(str, left_out))}" if len(left_out) else ""
    turn, worst = np.degrees(fit.turn_rad), np.degrees(sigma[3:].max())
    return (
        f"{_mm(fit.T[:3, 3])} mm, turned by {turn:.2f} degrees; known within "
        f"{1e3 * sigma[:3].max():.2f} mm and {worst:.2f} degrees (one sigma), "
        f"{len(fit.is_inlier)} points{seen}{wrong}"
    )


def mean_facts(mean: PoseMean) -> dict[str, Any]:
    """A pose that was seen many times, for JSON."""
    sigma = np.sqrt(np.diag(mean.covariance)).tolist()
    counts = {"looks": mean.looks, "left_out": mean.left_out}
    return {"T_task": mean.T.tolist(), "sigma": sigma} | counts


def mean_words(mean: PoseMean) -> str:
    """The same for people."""
    sigma = np.sqrt(np.diag(mean.covariance))
    return (
        f"{_mm(mean.T[:3, 3])} mm; known within {1e3 * sigma[:3].max():.2f} mm and "
        f"{np.degrees(sigma[3:].max()):.2f} degrees (one sigma), {mean.looks} looks, "
        f"{mean.left_out} left out"
    )


def port_facts(port: Port) -> dict[str, Any]:
    """A port for JSON."""
    return {
        "port_in_base_m": port.position.tolist(),
        "sigma_m": np.sqrt(np.diag(port.covariance)).tolist(),
        "rms_m": port.rms_m,
        "left_out": np.flatnonzero(~port.is_inlier).tolist(),
    }


def port_words(port: Port) -> str:
    """A port for people."""
    sigma = np.sqrt(np.diag(port.covariance))
    place = ", ".join(f"{value:.5f}" for value in port.position.tolist())
    return (
        f"port_in_base_m = [{place}], known within {1e3 * sigma.max():.2f} mm (one sigma), "
        f"{int(port.is_inlier.sum())} of {len(port.is_inlier)} lines, rms {1e3 * port.rms_m:.2f} mm"
    )


def _mm(place: Any) -> str:
    return ", ".join(f"{1e3 * value:.2f}" for value in place.tolist())
