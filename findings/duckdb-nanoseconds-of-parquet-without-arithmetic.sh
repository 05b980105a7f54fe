#!/bin/sh
# DuckDB 2: a time of Parquet in UTC with nanoseconds cannot be subtracted, truncated or compared with now().
#
# Expected: as a TIMESTAMP WITH TIME ZONE: pyarrow and pandas write such columns by default.
#           Guess before the run: comparing with a literal of that type works, and the difference is an INTERVAL.
# Found: the column is a TIMESTAMPTZ_NS, for which `-`, date_trunc and a comparison with TIMESTAMPTZ are no functions;
#        DuckDB 1.4 reads the same file as TIMESTAMP WITH TIME ZONE, with microseconds, and has all of them.
#        A comparison with text works in both, and so does epoch_ns, which gives all nanoseconds in DuckDB 2 only.
# Versions: duckdb 2.0.0 and 1.4.2, pyarrow 26.0.1.
# Concerns: who keeps stamps of sensors, which have nanoseconds, in Parquet, and asks questions in SQL.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
cat > run.py <<'PYTHON'
import sys

import duckdb
import pyarrow as pa
from pyarrow import parquet

times = pa.array([1767225600012545231, 1767225601012545232], pa.timestamp("ns", tz="UTC"))
parquet.write_table(pa.table({"time": times}), "a.parquet")
asked = ("typeof(time)", "epoch_ns(time)", "time > '2000-01-01'", "time > TIMESTAMPTZ '2000-01-01'", "time - time", "date_trunc('second', time)")
found = []
for what in asked:
    try:
        found.append(duckdb.sql(f"SELECT ({what})::VARCHAR FROM 'a.parquet' LIMIT 1").fetchall()[0][0])
    except duckdb.Error as error:
        found.append(type(error).__name__)
    print(f"duckdb {duckdb.__version__}: {what}: {found[-1]}")
expected = {
    "2.0.0": ["TIMESTAMPTZ_NS", "1767225600012545231", "true", "BinderException", "BinderException", "BinderException"],
    "1.4.2": ["TIMESTAMP WITH TIME ZONE", "1767225600012545000", "true", "true", "00:00:00", "2026-01-01 00:00:00+00"],
}
sys.exit(found != expected[duckdb.__version__])
PYTHON
for version in 2.0.0 1.4.2; do
  python3 -m venv "venv-$version"
  "venv-$version/bin/pip" install --quiet --disable-pip-version-check "duckdb==$version" pyarrow==26.0.1
  TZ=UTC "venv-$version/bin/python" run.py
done
