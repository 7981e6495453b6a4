#!/usr/bin/env bash
# Run a command in a clone of this checkout on a bare Debian: Python 3 with pip and venv, git, make and nothing else.
#   tools/bare_machine.sh [--suite SUITE] [--user] [--name FOLDER] "COMMAND"
# --suite: bookworm (Python 3.11, the default), trixie (3.13) or forky (3.14). --user: no root, and a read-only home.
# --name: name of the clone's folder, such as "a föld er". BARE_ROOT names the folder of the system (made if missing).
# Needs root, and debootstrap, which is installed where apt can; without them it says so loudly and exits with 0.
set -euo pipefail
suite=bookworm as_user=false name=src
while [[ ${1:-} == --* ]]; do
  case "$1" in
    --suite) suite=$2; shift 2 ;;
    --user) as_user=true; shift ;;
    --name) name=$2; shift 2 ;;
    *) echo "bare_machine: unknown option $1" >&2; exit 2 ;;
  esac
done
[[ $# == 1 ]] || { echo "usage: tools/bare_machine.sh [--suite SUITE] [--user] [--name FOLDER] \"COMMAND\"" >&2; exit 2; }
command=$1
checkout="$(cd "$(dirname "$0")/.." && pwd)"
root="${BARE_ROOT:-/var/tmp/semantic-mapper-bare-$suite}"

skip() {
  printf '\n########## THE BARE MACHINE WAS NOT TRIED: %s ##########\n\n' "$1" >&2
  exit 0
}

[[ $(id -u) == 0 ]] || skip "it needs root"
if ! command -v debootstrap >/dev/null; then
  { apt-get update -qq && apt-get install -y -qq debootstrap; } >/dev/null 2>&1 || skip "debootstrap cannot be installed"
fi
unmount() {
  for folder in dev sys proc; do umount -R -l "$root/$folder" 2>/dev/null || true; done
}
trap unmount EXIT
if [[ ! -x $root/usr/bin/git || ! -x $root/usr/bin/make ]]; then
  unmount
  rm -rf --one-file-system "$root"
  packages=python3,python3-pip,python3-venv,git,make,ca-certificates
  log="$(mktemp)"
  if ! debootstrap --variant=minbase "--include=$packages" "$suite" "$root" "" sid >"$log" 2>&1; then
    tail -n 5 "$log" >&2
    skip "debootstrap failed for $suite"
  fi
fi
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"
cp /etc/resolv.conf /etc/hosts "$root/etc/"
if [[ -f /etc/pip.conf ]]; then cp /etc/pip.conf "$root/etc/"; fi
for folder in proc sys dev; do
  mountpoint -q "$root/$folder" || { mount --rbind "/$folder" "$root/$folder" && mount --make-rslave "$root/$folder"; }
done

rm -rf --one-file-system "${root:?}/build"
mkdir -p "$root/build"
git clone -q "$checkout" "$root/build/$name"
certificates=/etc/ssl/certs/ca-certificates.crt  # this machine's, copied above: a proxy may have its own
variables=(PATH=/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin LANG=C.UTF-8)
variables+=("PIP_CERT=$certificates" "SSL_CERT_FILE=$certificates")
while IFS= read -r variable; do variables+=("$variable"); done < <(
  env | grep -E '^(SSL_CERT_[A-Z]+|PIP_CERT|PIP_INDEX_URL|PIP_EXTRA_INDEX_URL|PIP_DEFAULT_TIMEOUT|UV_[A-Z_]+|REQUESTS_CA_BUNDLE|CURL_CA_BUNDLE|GIT_SSL_[A-Z]+|[a-z]+_proxy|[A-Z]+_PROXY)=' || true)
if $as_user; then
  chroot "$root" useradd --create-home --home-dir /var/tester --uid 4321 tester 2>/dev/null || true
  chroot "$root" chown -R tester /build
  chroot "$root" chmod 555 /var/tester
  chroot --userspec=tester "$root" /usr/bin/env -i HOME=/var/tester "${variables[@]}" bash -c "cd '/build/$name' && $command"
else
  chroot "$root" /usr/bin/env -i HOME=/root "${variables[@]}" bash -c "cd '/build/$name' && $command"
fi
