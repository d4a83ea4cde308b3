"""x"""
import time
import pytest
pytestmark = pytest.mark.nightly

def test_same(cluster, alone):
    t=time.time()
    run = cluster.run("run")
    code = run.ended(120)
    print(time.time()-t)
    print(run.said())
    for w in ("one","two","scheduler","store"): print(w, cluster.processes[w].said()[-3000:])
    assert code == 0
