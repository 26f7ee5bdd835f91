"""Shell completion: the script that is printed completes verbs, options and choices in a real shell."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from drivelink import cli


def complete(script: Path, words: list[str]) -> set[str]:
    quoted = " ".join(f"'{word}'" for word in words)
    shell = f"source {script}; COMP_WORDS=({quoted}); COMP_CWORD={len(words) - 1}; _shtab_drivelink; "
    shell += 'printf "%s\\n" "${COMPREPLY[@]}"'
    result = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, check=True)
    return {line.strip() for line in result.stdout.splitlines()}


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_verbs_options_and_choices(tmp_path, capsys):
    assert cli.main(["completion", "bash"]) == 0
    script = tmp_path / "drivelink.bash"
    script.write_text(capsys.readouterr().out)
    assert set(cli.VERBS) <= complete(script, ["drivelink", ""])
    assert "--publish" in complete(script, ["drivelink", "replay", "--"])
    assert complete(script, ["drivelink", "demo", "--case", ""]) >= {"constant", "quadratic", "vsa-ii"}


def test_zsh_has_its_script_and_the_manual_page_every_verb(capsys):
    assert cli.main(["completion", "zsh"]) == 0
    assert "replay" in capsys.readouterr().out
    page = (Path(__file__).parent.parent / "packaging" / "drivelink.1").read_text(encoding="utf-8")
    for verb, summary in cli.VERBS.items():
        assert f".B {verb}\n{summary.replace('-', chr(92) + '-')}\n" in page
