# What a container of compose.yaml runs: sh cluster.sh head | worker | controller; and how its health is: sh cluster.sh healthy.
set -eu
# what Muster does not use of Ray: its object store (the least that Ray takes) and its copies of logs
small="--object-store-memory=80000000 --include-log-monitor=false"

begin() {
  echo "$1" >/tmp/role
  rm -rf /tmp/ray/ray_current_cluster   # of an earlier start of this container: its processes are gone
}

case "${1:-}" in
head)
  begin head
  exec ray start --head --block --port=6379 --node-ip-address="${RAY_HEAD%:*}" --node-name=head --num-cpus=0 \
    --include-dashboard=false $small
  ;;
worker)
  begin worker
  export WARP_CACHE_PATH=/muster/kernels
  # Ray itself gets the signal of `docker stop`, and drains. Without a head it ends, and Docker starts the container again.
  exec ray start --block --address="$RAY_HEAD" --node-name="$(hostname)" --num-cpus="$MUSTER_WORKER_CPUS" \
    --memory="$MUSTER_WORKER_MEMORY" $small
  ;;
controller)
  begin controller
  # Drivers run on a node of the cluster: this one, which has no CPUs for jobs. It ends when the head is away for too long.
  join() { ray start --address="$RAY_HEAD" --node-name=controller --num-cpus=0 $small; }
  until join; do sleep 2; done
  (while sleep 5; do grep -qs '^raylet' /proc/[0-9]*/comm || join || true; done) &
  muster serve --engine ray --host 0.0.0.0 --port 8080 --store /muster/store --trust-proxy "$MUSTER_PROXY" &
  serving=$!
  trap 'kill "$serving" 2>/dev/null || true' TERM INT
  until wait "$serving" || ! kill -0 "$serving" 2>/dev/null; do :; done   # a signal, too, ends a wait
  # The drivers end with this container. Each has its gang save and leave first, and nobody starts it again until then.
  drivers() { grep -ls 'orchestrator.engines.ray.drive[r]' /proc/[0-9]*/cmdline | cut -d/ -f3; }
  for driver in $(drivers); do kill "$driver" 2>/dev/null || true; done
  while [ -n "$(drivers)" ]; do sleep 0.2; done
  ;;
healthy)
  case "$(cat /tmp/role)" in
  head) grep -qs '^gcs_server' /proc/[0-9]*/comm ;;
  controller) exec python3 -c 'import urllib.request; urllib.request.urlopen("http://127.0.0.1:8080/healthz", timeout=5)' ;;
  *) grep -qs '^raylet' /proc/[0-9]*/comm ;;
  esac
  ;;
*)
  echo "usage: cluster.sh head|worker|controller|healthy" >&2
  exit 2
  ;;
esac
