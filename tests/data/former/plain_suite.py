"""test_plain.py: the suite that every engine passes."""

import pytest

from muster_plain import PlainEngine
from orchestrator.engines.api import Setting
from orchestrator.engines.testing.rigs import ShellRig
from orchestrator.engines.testing.suite import EngineSuite


class TestPlainEngine(EngineSuite):
    @pytest.fixture
    def rig(self, tmp_path):
        with ShellRig(tmp_path / "store", lambda: PlainEngine(Setting(tmp_path))) as rig:
            yield rig
