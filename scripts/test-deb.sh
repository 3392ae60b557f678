#!/usr/bin/env bash
# Installs, runs, upgrades and removes the Debian package as root on top of this machine, in an overlay that is thrown away:
# nothing of it reaches the machine. There is no systemd in there, so the programs are run as the units say: their user, folders,
# umask, environment and command line are taken from the installed unit files.
#
# usage: scripts/test-deb.sh FILE.deb [IMAGE..]   (images for the frame client; default: two of the test data)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

say() { printf 'test-deb: %s\n' "$*"; }
fail() {
    printf 'test-deb: %s\n' "$@" >&2
    [[ ! -s ${log:-} ]] || tail -n 20 "$log" >&2
    exit 1
}

outside() {
    ((EUID == 0)) || fail "needs root, for it installs a package (in an overlay that is thrown away)"
    [[ -f ${1:-} ]] || fail "usage: scripts/test-deb.sh FILE.deb [IMAGE..]"
    local deb images
    deb=$(realpath "$1")
    shift
    images=("$@")
    ((${#images[@]})) || mapfile -t images < <(find tests/data/cell -name '*.png' -o -name '*.jpg' | sort | head -n 2)
    ((${#images[@]})) || fail "no images for the frame client"
    local folder code=0
    folder=$(mktemp -d /var/tmp/samsod-deb.XXXXXX)
    # Everything that is started in there ends with it, and what is mounted is gone.
    unshare --mount --pid --fork --kill-child "$0" --in-namespace "$folder" "$deb" "${images[@]}" || code=$?
    rmdir "$folder"
    return "$code"
}

in_namespace() {
    local folder=$1 deb=$2
    shift 2
    mount -t tmpfs none "$folder"
    mkdir "$folder/upper" "$folder/work" "$folder/root"
    local root=$folder/root
    mount -t overlay overlay -o "lowerdir=/,upperdir=$folder/upper,workdir=$folder/work" "$root"
    mount --rbind /dev "$root/dev"
    mount -t tmpfs none "$root/dev/shm" -o mode=1777
    mount -t tmpfs none "$root/run" -o mode=755
    mount -t proc proc "$root/proc"
    mkdir "$root/package"
    cp "$deb" "$root/package/samsod.deb"
    mkdir "$root/package/images"
    cp "$@" "$root/package/images/"
    cp "$0" "$root/package/test-deb.sh"
    chroot "$root" /package/test-deb.sh --in-overlay
}

# Value of a key of a unit.
key() { sed -n "s/^$2=//p" "/usr/lib/systemd/system/$1"; }

# Runs what a unit runs, with `%i` in place of the instance.
run_as_unit() {
    local unit=$1 instance=${2:-} user command
    user=$(key "$unit" User)
    command=$(key "$unit" ExecStart)
    read -ra command <<<"${command//%i/$instance}"
    install -d -o "$user" -g "$user" -m "$(key "$unit" RuntimeDirectoryMode)" "/run/$(key "$unit" RuntimeDirectory)"
    install -d -o "$user" -g "$user" -m "$(key "$unit" StateDirectoryMode)" "/var/lib/$(key "$unit" StateDirectory)"
    cd "$(key "$unit" WorkingDirectory)"
    umask "$(key "$unit" UMask)"
    exec setpriv --reuid "$user" --regid "$user" --init-groups --no-new-privs --bounding-set=-all \
        env -i PATH=/usr/bin:/bin LANG=C.UTF-8 "${command[@]}"
}

get() {
    exec 3<>/dev/tcp/127.0.0.1/9464 || return 1
    printf 'GET %s HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n' "$1" >&3
    cat <&3
    exec 3>&-
}

# wait_for WHAT COMMAND..: a condition, under a deadline that only a failure reaches.
wait_for() {
    local what=$1 deadline=$((SECONDS + 120))
    shift
    until "$@" 2>/dev/null; do
        ((SECONDS < deadline)) || fail "$what: not within 120 s"
        sleep 0.1
    done
}
is_healthy() { [[ $(get /healthz) == "HTTP/1.1 200"*'"status":"ok"'* ]]; }
has_processed() {
    local processed
    processed=$(get /metrics | sed -n 's/^samsod_frames_processed_total \([0-9]*\).*/\1/p')
    ((processed >= $1))
}

in_overlay() {
    log=/package/samsodd.log
    export DEBIAN_FRONTEND=noninteractive
    local as_nobody=(setpriv --reuid nobody --regid nogroup --clear-groups)

    dpkg -i /package/samsod.deb >/package/dpkg.log 2>&1 || fail "dpkg -i failed" "$(cat /package/dpkg.log)"
    getent passwd samsod >/dev/null || fail "there is no user samsod"
    local file
    for file in samsodd samsod samsod-publish; do
        # Compressed or not.
        zgrep -q '^\.TH' "/usr/share/man/man1/$file.1"* || fail "no manual page $file"
    done
    [[ -s /usr/share/samsod/cell.schema.json ]] || fail "the schema of the configuration is not installed"
    bash -n /usr/share/bash-completion/completions/samsod
    say "installed: user $(id samsod)"

    (run_as_unit samsodd.service) >"$log" 2>&1 &
    local daemon=$!
    wait_for "health of samsodd" is_healthy
    install -d -o samsod /var/lib/samsod/images
    cp /package/images/* /var/lib/samsod/images/
    chmod a+r /var/lib/samsod/images/*
    (run_as_unit samsod-client@.service images) >/package/client.log 2>&1 &
    local client=$!
    wait_for "three frames of the client" has_processed 3
    say "runs as its unit says: $(get /healthz | tail -n 1)"

    # Another user finds nothing: neither shared memory nor the operator's socket.
    local refused
    for command in "publish --cell cell --root-path /run/samsod --count 1 --wait 1 /package/images" \
        "status --cell cell --root-path /run/samsod" "hold --cell cell --root-path /run/samsod"; do
        # shellcheck disable=SC2086 # words of a command line
        if refused=$("${as_nobody[@]}" samsod $command 2>&1); then fail "nobody may $command: $refused"; fi
    done
    say "another user is refused: $refused"

    sed -i 's/^stalled_after_ms = .*/stalled_after_ms = 7000/' /etc/samsod/cell.toml
    dpkg -i /package/samsod.deb >/package/dpkg.log 2>&1 || fail "the upgrade failed" "$(cat /package/dpkg.log)"
    grep -q '^stalled_after_ms = 7000' /etc/samsod/cell.toml || fail "the upgrade has changed cell.toml"
    is_healthy || fail "the upgrade has disturbed the running samsodd"
    say "upgraded: cell.toml is kept, samsodd goes on"

    kill -TERM "$client"
    kill -TERM "$daemon"
    wait "$daemon" || fail "samsodd ended with code $?"
    local recording
    recording=$(find /var/lib/samsod/recordings -name '*.mcap')
    samsod recording "$recording" >/package/recording.log || fail "the recording cannot be read"
    say "stopped: $(grep '^frames' "$log")"

    dpkg -r samsod >/package/dpkg.log 2>&1 || fail "dpkg -r failed" "$(cat /package/dpkg.log)"
    [[ ! -e /usr/bin/samsodd && -e /etc/samsod/cell.toml && -e $recording ]] || fail "removed too little or too much"
    dpkg -P samsod >/package/dpkg.log 2>&1 || fail "dpkg -P failed" "$(cat /package/dpkg.log)"
    [[ ! -e /etc/samsod/cell.toml && -e $recording ]] || fail "purged too little or too much"
    say "removed and purged: recordings stay"
}

case ${1:-} in
    --in-namespace) shift && in_namespace "$@" ;;
    --in-overlay) in_overlay ;;
    *) outside "$@" ;;
esac
