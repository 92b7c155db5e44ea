#!/usr/bin/env bash
# run_sanitizers.sh [BUILD]: builds the C++ tests under AddressSanitizer with UndefinedBehaviorSanitizer, and under
# ThreadSanitizer, and runs them.
# run_sanitizers.sh BUILD address,undefined|thread PYTEST_ARGUMENTS...: builds the Python module so instead and runs
# pytest with it. Only what the module does is watched: the interpreter and its packages are not instrumented.
set -euo pipefail
source="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
build="${1:-$(mktemp -d)}"

# ThreadSanitizer knows one layout of memory only: addresses must not be drawn at random.
fixed_addresses=()
if command -v setarch >/dev/null && setarch -R true 2>/dev/null; then fixed_addresses=(setarch -R); fi
export UBSAN_OPTIONS=print_stacktrace=1 TSAN_OPTIONS="halt_on_error=1 second_deadlock_stack=1"

if (($# > 1)); then
    kind="$2"
    shift 2
    python -m pip install --quiet --no-deps --upgrade --target "$build" "$source" \
        -Ccmake.define.UNI4D_FG_CPP_SANITIZE="$kind"
    library="$(g++ -print-file-name="lib$([[ $kind == thread ]] && echo t || echo a)san.so")"
    # The sanitizer looks for what throws exceptions before the module that uses it is loaded.
    library+=":$(g++ -print-file-name=libstdc++.so.6)"
    # What Python keeps until its end counts as leaked. The threads of NumPy's BLAS, which is not instrumented, stay out.
    export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
    PYTHONPATH="$build:${PYTHONPATH:-}" ASAN_OPTIONS=detect_leaks=0 \
        "${fixed_addresses[@]}" env LD_PRELOAD="$library" python -m pytest --numprocesses=0 "$@"
    exit
fi

for kind in address,undefined thread; do
    mkdir -p "$build/$kind"
    cmake -S "$source" -B "$build/$kind" -DUNI4D_FG_CPP_SANITIZE="$kind" \
        -DUNI4D_FG_CPP_MODULE=OFF -DUNI4D_FG_CPP_TESTS=ON >"$build/$kind/configure.log" || {
        cat "$build/$kind/configure.log"
        exit 1
    }
    cmake --build "$build/$kind" --parallel 2
    "${fixed_addresses[@]}" ctest --test-dir "$build/$kind" --output-on-failure
done
