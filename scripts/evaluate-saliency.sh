#!/usr/bin/env bash
# Measures saliency on every folder of images and masks in DATA: DATA itself, or the folders in it. Robot-cell scenes (a
# folder cell/) are measured before and after the separation of shadows. Results go to OUT, a folder for each.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

readonly data=${1:-} out=${2:-} size=${SIZE:-256}
readonly methods=background,centred,averaged,paper,fast
readonly peers=slic,felzenszwalb,spectral-residual,fine-grained

if [[ -z $data || -z $out ]]; then
    echo "usage: make evaluate-saliency DATA=DIR OUT=DIR [SIZE=256]" >&2
    echo "  DATA  a folder with images/ and masks/, and other methods' maps in maps/METHOD/; or one with such folders" >&2
    echo "  OUT   where tables, curves and contact sheets are written, a folder for each" >&2
    echo "  SIZE  longer side that everything is brought to, px" >&2
    exit 2
fi

evaluate() { # FOLDER NAME
    local folder=$1 name=$2 maps=() map
    local both=(--images "$folder/images" --masks "$folder/masks" --size "$size")
    for map in "$folder"/maps/*/; do
        [[ -d $map ]] && maps+=(--maps "$(basename "$map")=$map")
    done
    echo "== $name =="
    .venv/bin/python -m samsod.evaluation saliency "${both[@]}" "${maps[@]}" --run "$methods,$peers" --name "$name" \
        --out "$out/$name"
    .venv/bin/python -m samsod.evaluation sensitivity "${both[@]}" --name "$name" --out "$out/$name-sensitivity"
    .venv/bin/python -m samsod.evaluation speed --images "$folder/images" --size "$size" --out "$out/$name-speed"
}

found=0
for folder in "$data" "$data"/*/; do
    # Scenes of a cell have masks of part ids, which are no truth of saliency.
    if [[ -d $folder/images && -d $folder/masks && ! -f $folder/index.json ]]; then
        # Shadows alone are no salient objects.
        [[ $(basename "$folder") == shadows && $folder != "$data" ]] && continue
        evaluate "${folder%/}" "$(basename "$(cd "$folder" && pwd)")"
        found=1
    fi
done
if [[ -d $data/cell ]]; then
    echo "== cell =="
    .venv/bin/python -m samsod.evaluation saliency-cell "$data/cell" --out "$out/cell"
    found=1
fi
if ((!found)); then
    echo "$data: no images/ and masks/ in it, nor in a folder of it" >&2
    exit 2
fi
