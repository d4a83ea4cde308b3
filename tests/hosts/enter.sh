#!/bin/sh
# Enters a root of its own as a user without rights: its root is read-only, and what it writes lies in its own folders.
#
#   ROOT=FOLDER [IMAGE=FOLDER] [SEEN="FOLDER …"] OWN="FOLDER:INSIDE …" [ONLY_READ="INSIDE …"] NAME=NAME enter.sh COMMAND …
#
# IMAGE is the root of a container's image; without one, the root is empty but for the folders SEEN of this machine.
# To be called in a mount and a process namespace of its own (unshare --mount --pid --fork --uts --ipc).
set -eu
mount --make-rprivate /
if [ -n "${IMAGE:-}" ]; then
  mount --bind "$IMAGE" "$ROOT"
else
  mount -t tmpfs -o mode=755 tmpfs "$ROOT"
  for link in bin sbin lib lib64; do ln -s "usr/$link" "$ROOT/$link"; done
  mkdir "$ROOT/proc" "$ROOT/dev" "$ROOT/etc"
fi
for place in ${SEEN:-}; do
  mkdir -p "$ROOT$place"
  mount --bind "$place" "$ROOT$place"
  mount -o remount,bind,ro "$ROOT$place"
done
mount -t proc proc "$ROOT/proc"
mount -t tmpfs -o mode=755 tmpfs "$ROOT/dev"
for device in null zero full random urandom tty; do
  touch "$ROOT/dev/$device"
  mount --bind "/dev/$device" "$ROOT/dev/$device"
done
mkdir -m 1777 "$ROOT/dev/shm"
ln -s /proc/self/fd "$ROOT/dev/fd"
mount -t tmpfs -o mode=1777 tmpfs "$ROOT/dev/shm"
for pair in $OWN; do
  inside="$ROOT${pair#*:}"
  if [ -d "${pair%%:*}" ]; then mkdir -p "$inside"; elif [ ! -e "$inside" ]; then mkdir -p "${inside%/*}"; touch "$inside"; fi
  mount --bind "${pair%%:*}" "$inside"
done
for inside in ${ONLY_READ:-}; do mount -o remount,bind,ro "$ROOT$inside"; done
mount -o "remount,${IMAGE:+bind,}ro" "$ROOT"
hostname "$NAME"
cd "$ROOT"
exec chroot --userspec=10001:10001 "$ROOT" "$@"
