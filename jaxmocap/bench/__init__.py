"""The papers' tables and figures, measured on this machine."""

from __future__ import annotations

from . import lsdt_report

BENCHES = {"lsdt": lsdt_report}
