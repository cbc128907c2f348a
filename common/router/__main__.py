"""`python -m common.router`."""

from __future__ import annotations

from common.router.router import main

main()
