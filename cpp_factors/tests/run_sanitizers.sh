#!/usr/bin/env bash
# Builds the C++ tests under AddressSanitizer and UndefinedBehaviorSanitizer and runs them.
set -euo pipefail
source="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
build="${1:-$(mktemp -d)}"
mkdir -p "$build"
cmake -S "$source" -B "$build" \
    -DUNI4D_FG_CPP_MODULE=OFF -DUNI4D_FG_CPP_TESTS=ON -DUNI4D_FG_CPP_SANITIZE=ON >"$build/configure.log" || {
    cat "$build/configure.log"
    exit 1
}
cmake --build "$build" --parallel 2
UBSAN_OPTIONS=print_stacktrace=1 ctest --test-dir "$build" --output-on-failure
