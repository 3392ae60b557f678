#!/usr/bin/env bash
# Clears a simulated table: a cell twin composes frames of the parts that still lie there and publishes them through shared
# memory; samsodd finds, picks and places them by its assembly list until the jig is full. Everything is written to demo-output/.
# Ends with the line `placed 6 of 6, 0 collisions, worst pick error X mm`, and with an exit code other than 0 if it is another.
#
# usage: scripts/demo.sh [SEED]
#   SEED        which random table, default 7
# environment:
#   CONTROLLER  simulated (default), or motoman: the same through TCP, against the emulated controller
#   OUT         folder for everything, default demo-output
#   PARTS       what lies on the table and goes into the jig, in this order: up to eight names with commas
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

readonly seed=${1:-7}
readonly controller=${CONTROLLER:-simulated}
readonly parts=${PARTS:-sensor_box,star_knob,hex_nut,t_piece,bearing,terminal_block}
readonly out=${OUT:-demo-output}
readonly data=tests/data
readonly background=$data/tables/blue_belt.jpg
readonly bin=target/release
# Nobody waits longer than this for a run of half a minute.
readonly limit_s=240

fail() {
    printf 'demo: %s\n' "$@" >&2
    exit 1
}
[[ $seed =~ ^[0-9]+$ ]] || fail "SEED = $seed; must be a whole number"
[[ $controller == simulated || $controller == motoman ]] ||
    fail "CONTROLLER = $controller; must be simulated or motoman"
for program in samsodd samsod; do
    [[ -x $bin/$program ]] || fail "$bin/$program is missing; run 'make build'"
done
IFS=, read -ra names <<<"$parts"
((${#names[@]} <= 8)) || fail "PARTS = $parts; the jig has eight slots"

processes=()
# shellcheck disable=SC2317,SC2329  # called by the trap
clean_up() {
    local status=$? process
    trap - EXIT INT TERM
    for process in "${processes[@]}"; do
        kill -TERM "$process" 2>/dev/null || true
        wait "$process" 2>/dev/null || true
    done
    exit "$status"
}
trap clean_up EXIT
trap 'exit 130' INT
trap 'exit 143' TERM

[[ ! -e $out || -f $out/cell.toml ]] || fail "OUT = $out is there, and is not of a demo"
rm -rf "$out"
mkdir -p "$out"
# A cell of its own: the demo must not meet a service that runs on this machine.
readonly cell="demo-$$"
configure() {
    cat <<TOML
[cell]
name = "$cell"

[camera]
file = "$PWD/$data/cell/camera.toml"
object_height_mm = 15.0

[catalogue]
folder = "$PWD/$data/parts"

[recording]
folder = "$out"
# A demo needs some megabytes, not what a service keeps free.
min_free_mib = 64
image_encoding = "jpeg"

[robot]
controller = "$controller"
armed = true
# Beside the table, out of the camera's view.
home = { x_mm = 250.0, y_mm = 330.0, z_mm = 250.0, rx_deg = 180.0, ry_deg = 0.0, rz_deg = 0.0 }
joint_speed_fraction = 0.6
linear_speed_mm_s = 300.0
safe_height_mm = 120.0

[robot.gripper]
opening_mm = 72.0

[robot.simulated]
table = "table.json"

[robot.motoman]
address = "${1:-127.0.0.1:10080}"
part_sensor = { start_address = 20030, bit = 4 }
emergency_stop = { start_address = 80020, bit = 5 }

[jig]
order = [
TOML
    local i row
    for i in "${!names[@]}"; do
        row=$((i / 4))
        printf '    { part = "%s", x_mm = %d.0, y_mm = %d.0, yaw_deg = 90.0 },\n' \
            "${names[i]}" $((150 + i % 4 * 110)) $((340 + row * 110))
    done
    echo "]"
}
# The table is laid before there is a table to read.
echo '{"version": 1, "parts": []}' >"$out/table.json"
configure >"$out/cell.toml"
echo "demo: ${#names[@]} parts at random on the table (seed $seed), a jig beside it"
"$bin/samsod" twin table --parts "$parts" --seed "$seed" --config "$out/cell.toml" --out "$out/table.json"

if [[ $controller == motoman ]]; then
    : >"$out/emulator.log"
    "$bin/samsod" emulate motoman --listen 127.0.0.1:0 --config "$out/cell.toml" --table "$out/table.json" \
        --journal "$out/journal.jsonl" >"$out/emulator.txt" 2>>"$out/emulator.log" &
    processes+=($!)
    for ((i = 0; i < 100; i++)); do
        address=$(sed -n 's/^listening on //p' "$out/emulator.log")
        [[ -n $address ]] && break
        sleep 0.1
    done
    [[ -n $address ]] || fail "the emulated controller did not start; see $out/emulator.log"
    echo "demo: an emulated Yaskawa controller listens on $address"
    configure "$address" >"$out/cell.toml"
fi

echo "demo: samsodd on the cell '$cell'; its messages go to $out/samsodd.log"
timeout --signal=TERM "$limit_s" "$bin/samsodd" --config "$out/cell.toml" --until-jig-is-full \
    >"$out/report.txt" 2>"$out/samsodd.log" &
daemon=$!
# The frame client goes first at the end: a frame that arrives while the service ends would be counted as lost.
"$bin/samsod" twin run --table "$out/table.json" --config "$out/cell.toml" --background "$background" --exposure 1.15 \
    --rate 10 --wait 30 >"$out/twin.txt" 2>"$out/twin.log" &
twin=$!
processes=("$twin" "$daemon" "${processes[@]}")
echo "demo: samsod twin run sends frames of what lies on the table, until the jig is full"

# Whichever ends first: the jig is full, or something went wrong.
wait -n "$daemon" "$twin" || true
if kill -0 "$daemon" 2>/dev/null; then
    tail -n 5 "$out/twin.log" >&2
    fail "the twin ended before the jig was full"
fi
status=0
wait "$daemon" || status=$?
kill -TERM "$twin" 2>/dev/null || true
wait "$twin" || true
if [[ $controller == motoman ]]; then
    # Its table and its journal are complete when it has ended.
    kill -TERM "${processes[2]}" 2>/dev/null || true
    wait "${processes[2]}" || fail "the emulated controller failed; see $out/emulator.log"
fi

echo
cat "$out/report.txt" "$out/twin.txt"
recording=$(find "$out" -name '*.mcap' | head -n 1)
[[ -n $recording ]] || fail "samsodd wrote no recording to $out"
echo
"$bin/samsod" recording "$recording" --sheet "$out/sheet.png" --frames 4
echo
echo "recording:     $recording"
echo "contact sheet: $out/sheet.png (frame, partitions, saliency, regions, objects and shadows, parts)"
echo
if ((status != 0)); then
    tail -n 5 "$out/samsodd.log" >&2
    echo "demo: samsodd ended with code $status; its messages are in $out/samsodd.log" >&2
fi
"$bin/samsod" twin score --table "$out/table.json" && exit "$status"
