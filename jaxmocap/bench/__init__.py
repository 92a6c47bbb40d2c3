"""The papers' tables and figures, measured on this machine."""

from __future__ import annotations

from . import lossless_report, lsdt_report, rd_report

BENCHES = {"lossless": lossless_report, "lsdt": lsdt_report, "rd": rd_report}
