# runall.sh NAME... : copies the attack's survey (old products stay there) and runs anew into /tmp/doubled/NAME
. /tmp/q.sh /work/wt/doubled
for n in "$@"; do mkdir -p /tmp/doubled/$n; (cd /tmp/attack65/$n; cp *.toml *.csv *.parquet /tmp/doubled/$n/); rm -rf /tmp/doubled/$n/store; (time nice -n 5 roadscan run /tmp/doubled/$n/SURVEY.toml >/tmp/doubled/$n/log 2>&1) 2>&1 | grep real; done
