"""What the pages say of this build: version and, where the clone has an address that a browser can open, the repository."""

import subprocess
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


def on_config(config: Any) -> Any:
    """Mkdocs calls this once it has read mkdocs.yml."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    revision = _git("rev-parse", "--short", "HEAD")
    config.copyright = f"marlbc_mj {version}{f', revision {revision}' if revision else ''}. Apache-2.0"
    config.site_name = f"marlbc_mj {version}"
    address = _git("remote", "get-url", "origin").removesuffix(".git")
    if address.startswith("https://") and "@" not in address:  # no password of anybody
        config.repo_url, config.repo_name = address, "/".join(address.split("/")[-2:])
    return config


def _git(*command: str) -> str:
    """What git says; nothing where there is no clone."""
    try:
        done = subprocess.run(["git", *command], cwd=ROOT, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
