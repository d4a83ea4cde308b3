"""An S3 server of the tests' own (moto's), and its requests."""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from urllib.request import Request, urlopen

KEYS = {"AWS_ACCESS_KEY_ID": "roads", "AWS_SECRET_ACCESS_KEY": "roads", "AWS_DEFAULT_REGION": "us-east-1"}


@dataclass
class ObjectStore:
    """A running S3 server with one bucket."""

    endpoint: str
    requests: list[tuple[str, str]] = field(default_factory=list)
    """Method and path of each request since the list was last emptied."""

    @property
    def url(self) -> str:
        """The bucket, as a survey file names it."""
        return "s3://roads"

    @property
    def environment(self) -> dict[str, str]:
        """What a process needs to reach it."""
        return {**KEYS, "FSSPEC_S3_ENDPOINT_URL": self.endpoint}

    def counts(self) -> Counter[str]:
        """Return the requests by method."""
        return Counter(method for method, _ in self.requests)


@contextmanager
def served() -> Iterator[ObjectStore]:
    """Serve S3 on this machine; processes of this one and its children reach it."""
    import fsspec
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import WSGIRequestHandler, make_server

    application = DomainDispatcherApplication(create_backend_app)
    seen: list[tuple[str, str]] = []

    class Quiet(WSGIRequestHandler):
        def log_request(self, *_: object) -> None:
            seen.append((self.command, self.path))

    server = make_server("127.0.0.1", 0, application, threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    store = ObjectStore(f"http://127.0.0.1:{server.server_port}", seen)
    before = {name: os.environ.get(name) for name in store.environment}
    conf = dict(fsspec.config.conf)
    os.environ.update(store.environment)
    fsspec.config.conf["s3"] = {"endpoint_url": store.endpoint}
    urlopen(Request(f"{store.endpoint}/moto-api/reset", method="POST")).close()  # of a server before this one
    fs = fsspec.filesystem("s3", skip_instance_cache=True)
    fs.mkdir("roads")
    try:
        yield store
    finally:
        fsspec.config.conf.clear()
        fsspec.config.conf.update(conf)
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
        server.shutdown()
        server.server_close()
        thread.join()
        type(fs).clear_instance_cache()
