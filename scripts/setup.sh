#!/usr/bin/env bash
# Checks that this machine can build samsod and installs what is missing: Debian packages (as root; otherwise the one
# command to run is printed), and a Python environment in .venv with pinned tools. `setup.sh lint` adds what only the
# checks need, `setup.sh deb` what only the Debian package needs, `setup.sh test` what only the tests need, `setup.sh camera` what
# the camera client needs, `setup.sh peers` OpenCV's saliency for comparison.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

readonly purpose=${1:-build}
readonly least_cargo=1.89.0
readonly requirements=crates/python/requirements-dev.txt

say() { printf 'setup: %s\n' "$*"; }
fail() {
    printf 'setup: %s\n' "$@" >&2
    exit 1
}
has() { command -v "$1" >/dev/null 2>&1; }

has_libclang() {
    [[ -n ${LIBCLANG_PATH:-} ]] || compgen -G '/usr/lib/llvm-*/lib/libclang*.so*' >/dev/null \
        || { [[ -x /sbin/ldconfig ]] && /sbin/ldconfig -p | grep -q 'libclang.*\.so'; }
}

missing_packages() {
    { has cc && has c++; } || echo build-essential
    has pkg-config || echo pkg-config
    has clang || echo clang
    has_libclang || echo libclang-dev
    # Calibrating a camera needs OpenCV, and so do the benchmarks.
    { has pkg-config && pkg-config --exists opencv4; } || echo libopencv-dev
    { has python3 && python3 -c 'import ensurepip, venv' 2>/dev/null; } || echo python3-venv
    # The tests of the operator's page run in it. A system that has a browser has letters.
    if [[ $purpose == test ]] && ! has chromium; then printf '%s\n' chromium fonts-dejavu-core; fi
    # It finds out which packages the programs need.
    if [[ $purpose == deb ]] && ! has dpkg-shlibdeps; then echo dpkg-dev; fi
    if [[ $purpose == camera ]]; then
        { has pkg-config && pkg-config --exists aravis-0.8 2>/dev/null; } || echo libaravis-dev
        # libaravis-dev needs it and does not say so.
        { has pkg-config && pkg-config --exists libusb-1.0 2>/dev/null; } || echo libusb-1.0-0-dev
        has arv-fake-gv-camera-0.8 || echo aravis-tools
    fi
    # An unprivileged user can do without: the checks say so and skip the scripts.
    if [[ $purpose == lint && $EUID -eq 0 ]] && has apt-get && ! has shellcheck; then echo shellcheck; fi
}

install_packages() {
    local packages
    mapfile -t packages < <(missing_packages)
    ((${#packages[@]})) || return 0
    if ! has apt-get; then
        fail "missing: ${packages[*]} (names of Debian 12); install them with your system's package manager"
    fi
    if ((EUID != 0)); then
        fail "missing Debian packages; run this once, then again what you ran:" \
            "    sudo sh -c 'apt-get update && apt-get install -y --no-install-recommends ${packages[*]}'"
    fi
    say "installing Debian packages: ${packages[*]}"
    export DEBIAN_FRONTEND=noninteractive
    apt-get update -qq </dev/null
    apt-get install -y -qq --no-install-recommends "${packages[@]}" </dev/null >/dev/null
}

check_rust() {
    local rustup_hint="install it with rustup (https://rustup.rs); Debian's own rustc is too old"
    has cargo || fail "cargo is missing; $rustup_hint"
    local version
    version=$(cargo --version | cut -d' ' -f2)
    if [[ $(printf '%s\n' "$least_cargo" "${version%%-*}" | sort -V | head -n1) != "$least_cargo" ]]; then
        fail "cargo $version is older than $least_cargo; run 'rustup update stable', or $rustup_hint"
    fi
    if [[ $purpose == deb ]] && ! cargo deb --version >/dev/null 2>&1; then
        say "installing cargo-deb"
        cargo install --locked --quiet cargo-deb </dev/null
    fi
    [[ $purpose == lint ]] || return 0
    local component
    for component in clippy fmt; do
        cargo "$component" --version >/dev/null 2>&1 && continue
        has rustup || fail "cargo $component is missing; $rustup_hint"
        say "adding cargo $component"
        rustup component add "${component/fmt/rustfmt}"
    done
}

install_python() {
    python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
        || fail "$(python3 --version) is too old; samsod needs Python 3.11 or newer"
    # The copy of the requirements inside the environment tells whether it is up to date.
    cmp -s "$requirements" .venv/requirements-dev.txt && [[ -x .venv/bin/python ]] && return 0
    say "making the Python environment .venv"
    [[ -x .venv/bin/python ]] || python3 -m venv --clear .venv
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --requirement "$requirements" </dev/null
    cp "$requirements" .venv/requirements-dev.txt
}

# 70 MB that only the comparison of saliency needs.
install_peers() {
    [[ $purpose == peers ]] || return 0
    .venv/bin/python -c 'import cv2; cv2.saliency' 2>/dev/null && return 0
    say "installing OpenCV's saliency module into .venv"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check opencv-contrib-python-headless==5.0.0.93 </dev/null
}

install_packages
check_rust
install_python
install_peers
