from __future__ import annotations

from pathlib import Path

import pytest
from plane import make_record

from overfly.data.record import write_record


@pytest.fixture
def record_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "records" / "plane"
    folder.parent.mkdir()
    write_record(make_record(), folder)
    return folder
