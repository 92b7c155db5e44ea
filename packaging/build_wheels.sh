#!/usr/bin/env bash
# Builds the wheels of both packages: packaging/build_wheels.sh OUT
# The wheel of the extension is repaired for old Linux systems (manylinux) where auditwheel and patchelf are installed.
set -euo pipefail
out="$(mkdir -p "${1:?give the folder of the wheels}" && cd "$1" && pwd)"
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python="${PYTHON:-python3}"

versions="$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml cpp_factors/pyproject.toml | sort -u)"
if [[ "$(wc -l <<<"$versions")" -ne 1 ]]; then
    echo "the two packages have different versions: $(tr '\n' ' ' <<<"$versions")" >&2
    exit 1
fi

raw="$(mktemp -d)"
trap 'rm -rf "$raw"' EXIT
"$python" -m pip wheel --quiet --no-deps --wheel-dir "$out" .
"$python" -m pip wheel --quiet --no-deps --wheel-dir "$raw" ./cpp_factors
if command -v auditwheel >/dev/null && command -v patchelf >/dev/null; then
    auditwheel repair --wheel-dir "$out" "$raw"/*.whl
else
    echo "note: auditwheel or patchelf is not installed: the wheel of the extension fits this system only" >&2
    cp "$raw"/*.whl "$out"
fi
ls -l "$out"
