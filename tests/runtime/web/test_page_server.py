"""The server of `idesplat web --serve`."""

import threading
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

import pytest
from idesplat.runtime.web.serving import page_server


def test_it_isolates_the_page_and_serves_the_folder_alone(tmp_path: Path) -> None:
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "worker.mjs").write_text("1")
    (tmp_path / "secret").write_text("1")
    with page_server(tmp_path / "page", "127.0.0.1", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}"
        with urlopen(f"{address}/worker.mjs") as answer:
            assert answer.headers["Content-Type"] == "text/javascript"
            assert answer.headers["Cross-Origin-Opener-Policy"] == "same-origin"
            assert answer.headers["Cross-Origin-Embedder-Policy"] == "require-corp"
        with pytest.raises(HTTPError, match="404"):
            urlopen(f"{address}/../secret")
        server.shutdown()


@pytest.mark.parametrize(("error", "printed"), [(ConnectionResetError(), False), (ValueError("wrong"), True)])
def test_a_client_that_closes_its_connection_prints_nothing(tmp_path: Path, capsys, error, printed: bool) -> None:
    with page_server(tmp_path, "127.0.0.1", 0) as server:
        try:
            raise error
        except type(error):
            server.handle_error(None, ("127.0.0.1", 1))
    assert ("Traceback" in capsys.readouterr().err) == printed
