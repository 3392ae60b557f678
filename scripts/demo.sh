#!/usr/bin/env bash
# Runs samsodd with the bundled catalogue and a frame client as two processes on bundled frames, and shows what came of it:
# the table of the run, the recording and a contact sheet. Everything is written to demo-output/.
#
# usage: scripts/demo.sh [FRAMES]
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# Three rounds of four frames: the four rows of the contact sheet, spread evenly, then show four different ones, as long as
# no frame is dropped.
readonly frames=${1:-12}
# The service takes the latest frame and drops those before it. Recognising ten parts takes two cores about half a second,
# and more if others use them.
readonly rate_hz=1
readonly out=demo-output
readonly data=tests/data
# Those of the bundled frames that one camera took, so that places are in true millimetres: cell/camera.toml is that camera.
readonly images=(0008 0022 0032 0039)
readonly bin=target/release

fail() {
    printf 'demo: %s\n' "$@" >&2
    exit 1
}
[[ $frames =~ ^[1-9][0-9]*$ ]] || fail "FRAMES = $frames; must be a whole number above 0"
# Nobody waits longer than this for a run of some seconds.
readonly limit_s=$((60 + 5 * frames / rate_hz))
for program in samsodd samsod; do
    [[ -x $bin/$program ]] || fail "$bin/$program is missing; run 'make build'"
done

daemon=
client=
# shellcheck disable=SC2317,SC2329  # called by the trap
clean_up() {
    local status=$?
    trap - EXIT INT TERM
    # The client first: a frame that arrives while the service ends would be counted as lost.
    local process
    for process in $client $daemon; do
        kill -TERM "$process" 2>/dev/null || true
        wait "$process" 2>/dev/null || true
    done
    exit "$status"
}
trap clean_up EXIT
trap 'exit 130' INT
trap 'exit 143' TERM

rm -rf "$out"
mkdir -p "$out/frames"
for image in "${images[@]}"; do
    cp "$data/cell/$image.jpg" "$out/frames/"
done
# A cell of its own: the demo must not meet a service that runs on this machine.
readonly cell="demo-$$"
cat >"$out/cell.toml" <<TOML
[cell]
name = "$cell"

[camera]
file = "../$data/cell/camera.toml"
object_height_mm = 15.0

[catalogue]
folder = "../$data/parts"

[recording]
folder = "$out"
# A demo needs some megabytes, not what a service keeps free.
min_free_mib = 64
TOML

echo "demo: samsodd on the cell '$cell'; its messages go to $out/samsodd.log"
timeout --signal=TERM "$limit_s" "$bin/samsodd" --config "$out/cell.toml" --frames "$frames" \
    >"$out/report.txt" 2>"$out/samsodd.log" &
daemon=$!

echo "demo: samsod publish sends the frames in $out/frames, $rate_hz a second, until $frames are processed"
# The client waits until the service listens, and counts what it sends on a terminal.
"$bin/samsod" publish "$out/frames" --cell "$cell" --rate "$rate_hz" --loop --wait 20 >"$out/publish.txt" &
client=$!

# Whichever ends first: the service has its frames, or something went wrong.
wait -n "$daemon" "$client" || true
if kill -0 "$daemon" 2>/dev/null; then
    fail "the frame client ended before the service had $frames frames"
fi
status=0
wait "$daemon" || status=$?
daemon=
kill -TERM "$client" 2>/dev/null || true
wait "$client" || true
client=
if ((status != 0)); then
    tail -n 20 "$out/samsodd.log" >&2
    fail "samsodd ended with code $status; its messages are in $out/samsodd.log"
fi

echo
cat "$out/report.txt" "$out/publish.txt"
recording=$(find "$out" -name '*.mcap' | head -n 1)
[[ -n $recording ]] || fail "samsodd wrote no recording to $out"
echo
"$bin/samsod" recording "$recording" --sheet "$out/sheet.png" --frames ${#images[@]}
echo
echo "recording:     $recording"
echo "contact sheet: $out/sheet.png (frame, partitions, saliency, regions, objects and shadows, parts)"
