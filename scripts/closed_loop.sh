#!/usr/bin/env bash
# Clears random tables, each with six of the bundled parts, as scripts/demo.sh clears one; tells what came of each and of all.
#
# usage: scripts/closed_loop.sh [TABLES]
#   TABLES      how many, default 20; the seeds are 1 to TABLES
# environment:
#   CONTROLLER  simulated (default) or motoman
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

readonly tables=${1:-20}
readonly out=${OUT:-loop-output}
[[ $tables =~ ^[1-9][0-9]*$ ]] || {
    echo "closed_loop: TABLES = $tables; must be a whole number above 0" >&2
    exit 1
}
# Without the flange, which is wider than the gripper opens, and the plates and the housing, which leave no room in the jig.
readonly pool=(bearing cable_clip hex_bolt hex_nut hex_standoff l_bracket sensor_box socket_screw spur_gear star_knob
    stepped_shaft t_piece terminal_block u_channel washer wing_nut)

mkdir -p "$out"
rm -f "$out"/*.txt
failed=0
for ((seed = 1; seed <= tables; seed++)); do
    # The same seed draws the same parts.
    RANDOM=$seed
    parts=$(for part in "${pool[@]}"; do echo "$RANDOM $part"; done | sort -n | head -n 6 | cut -d' ' -f2 | paste -sd, -)
    status=0
    PARTS=$parts OUT="$out/$seed" scripts/demo.sh "$seed" >"$out/$seed.txt" 2>&1 || status=$?
    ((status == 0)) || failed=$((failed + 1))
    printf 'table %2d  %s  exit %d  %s\n' "$seed" "$(tail -n 1 "$out/$seed.txt")" "$status" "$parts"
    # The recordings of many tables are large; the report says what was in them.
    rm -f "$out/$seed"/*.mcap
done
# Median and 99th percentile of the number before ` ms` behind a name, over all parts that were placed.
spread() {
    grep -hE '^slot .* placed$' "$out"/*.txt | sed -nE "s/.*$1 +([0-9]+) ms.*/\\1/p" | sort -n | awk -v name="$1" '
        { value[NR] = $1 }
        END { if (NR) printf "%-18s %6d ms median  %6d ms p99  of %d parts\n", name,
                  value[1 + int((NR - 1) * 0.5 + 0.5)], value[1 + int((NR - 1) * 0.99 + 0.5)], NR }'
}
echo
spread "frame to command"
spread waited
spread took
echo "tables $tables, failed $failed"
exit $((failed > 0))
