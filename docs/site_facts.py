"""What the pages say of this build: version and, where its address is known, the repository."""

import os
import subprocess
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


def on_config(config: Any) -> Any:
    """Mkdocs calls this once it has read mkdocs.yml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version, revision = project["version"], _git("rev-parse", "--short", "HEAD")
    config.copyright = f"marlbc_mj {version}{f', revision {revision}' if revision else ''}. Apache-2.0"
    config.site_name = f"marlbc_mj {version}"
    address = repository(project.get("urls", {}))
    if address:
        config.repo_url, config.repo_name = address, "/".join(address.split("/")[-2:])
    return config


def repository(urls: dict[str, str]) -> str:
    """Address of the repository that a browser can open; empty where none is known.

    The first of: the variable ``REPOSITORY_URL``, ``Repository`` among the project's addresses, git's remote ``origin``.
    """
    given = os.environ.get("REPOSITORY_URL") or urls.get("Repository") or _git("remote", "get-url", "origin")
    address = given.strip().rstrip("/").removesuffix(".git")
    return address if address.startswith("https://") and "@" not in address else ""  # no password of anybody


def _git(*command: str) -> str:
    """What git says; nothing where there is no clone."""
    try:
        done = subprocess.run(["git", *command], cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
