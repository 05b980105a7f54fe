"""``python -m tools.truth``; see the package."""

from tools.truth.table import main

raise SystemExit(main())
