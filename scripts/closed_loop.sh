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
# All that the gripper of the demo can take: the flange and the plates are wider than it opens.
readonly pool=(bearing cable_clip hex_bolt hex_nut hex_standoff l_bracket sensor_box socket_screw spur_gear star_knob
    stepped_shaft t_piece terminal_block u_channel washer wing_nut)

mkdir -p "$out"
rm -f "$out"/*.txt
failed=0
for ((seed = 1; seed <= tables; seed++)); do
    parts=$(shuf -n 6 --random-source=<(yes "$seed") -e "${pool[@]}" | paste -sd, -)
    status=0
    PARTS=$parts OUT="$out/$seed" scripts/demo.sh "$seed" >"$out/$seed.txt" 2>&1 || status=$?
    ((status == 0)) || failed=$((failed + 1))
    printf 'table %2d  %s  exit %d  %s\n' "$seed" "$(tail -n 1 "$out/$seed.txt")" "$status" "$parts"
    # The recordings of many tables are large; the report says what was in them.
    rm -f "$out/$seed"/*.mcap
done
echo
cat "$out"/*.txt | grep -E '^slot .* placed$' | awk '
    { for (i = 1; i < NF; i++) {
        if ($i == "command") gap[n] = $(i + 1)
        if ($i == "waited") waited[n] = $(i + 1)
        if ($i == "took") took[n] = $(i + 1)
      } n++ }
    function at(values, share,   sorted) { asort(values, sorted); return sorted[1 + int((n - 1) * share + 0.5)] }
    END { printf "%d parts placed\n", n
          printf "frame to command  %6.0f ms median  %6.0f ms p99\n", at(gap, .5), at(gap, .99)
          printf "robot waited      %6.0f ms median  %6.0f ms p99\n", at(waited, .5), at(waited, .99)
          printf "a part took       %6.0f ms median  %6.0f ms p99\n", at(took, .5), at(took, .99) }' || true
echo "tables $tables, failed $failed"
exit $((failed > 0))
