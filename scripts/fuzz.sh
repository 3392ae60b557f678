#!/usr/bin/env bash
# Fuzzes what reads bytes of others: the network, frames, recordings; each for some seconds, from the committed corpus on. Needs a nightly
# compiler (rustup toolchain install nightly); installs cargo-fuzz if it is missing. What is found lies in fuzz/artifacts.
#
# usage: scripts/fuzz.sh [SECONDS]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

readonly seconds=${1:-60}
[[ $seconds =~ ^[1-9][0-9]*$ ]] || {
    echo "fuzz: SECONDS = $seconds; must be a whole number above 0" >&2
    exit 2
}
if ! cargo +nightly --version >/dev/null 2>&1; then
    echo "fuzz: no nightly compiler; cargo test runs the same entry points on the corpus and on random bytes" >&2
    exit 1
fi
# Beside what is built: nothing is installed outside the project.
readonly tools=$PWD/target/tools
export PATH=$tools/bin:$PATH
command -v cargo-fuzz >/dev/null || cargo install --locked --quiet --root "$tools" cargo-fuzz
# Folders that the target of recordings worked in, of processes that are no more.
tidy() {
    local folder
    for folder in /dev/shm/samsod-fuzz-*; do
        [[ ! -d $folder || -d /proc/${folder##*-} ]] || rm -r "$folder"
    done
}
trap tidy EXIT
for target in reply request frame recording; do
    # New inputs are kept in target: the committed corpus stays small.
    mkdir -p "target/fuzz-corpus/$target"
    cargo +nightly fuzz run --target-dir target/fuzz "$target" "$PWD/target/fuzz-corpus/$target" "$PWD/fuzz/corpus/$target" -- \
        -max_total_time="$seconds" -verbosity=0 -print_final_stats=1
done
