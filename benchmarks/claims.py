"""Every text of the docs that holds results, with the file and the command that it comes from.

    python benchmarks/claims.py

Markdown, from ``claims.toml``; the tests hold each text against its page.
"""

import json
import re
import tomllib
from pathlib import Path

FOLDER = Path(__file__).parent


def main() -> None:
    """Print a row for each text."""
    claims = tomllib.loads((FOLDER / "claims.toml").read_text("utf-8"))["claims"]
    print("| page | text | result | command |\n|---|---|---|---|")
    for claim in claims:
        name = claim["result"]
        made = {"command": "python benchmarks/paper/tables.py"}
        if name.endswith(".json"):
            made = json.loads((FOLDER / "results" / name).read_text("utf-8"))
        command = made.get(
            "command", "python benchmarks/paper/train.py Ev-Objects.zip Ev-Containers.zip -o FOLDER"
        )
        for text in claim["texts"]:
            shown = re.sub(r"\{[^{}]+\}", "…", text).replace("|", "/")
            print(f"| {claim['page']} | {shown} | {name} | `{command}` |")


if __name__ == "__main__":
    main()
