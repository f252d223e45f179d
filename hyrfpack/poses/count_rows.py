"""Answers each line of standard input with the number of rows in a table of an SQLite database.

`watch.RowCounter` runs this file in a process of its own: `python count_rows.py DATABASE TABLE`. pycolmap has a copy of
SQLite of its own. If its process also opened the database with Python's copy, closing it would drop the locks of both
on POSIX systems, and the database could be damaged (https://sqlite.org/howtocorrupt.html, section 2.2).
"""

from __future__ import annotations

import sqlite3
import sys
from pathlib import Path


def main(database: str, table: str) -> None:
    """Answer until standard input ends, with a number or, if the table cannot be read at the moment, the reason."""
    uri = f"{Path(database).resolve().as_uri()}?mode=ro"
    for _ in sys.stdin:
        try:
            connection = sqlite3.connect(uri, uri=True, timeout=0.5)
            try:
                answer = str(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
            finally:
                connection.close()
        except sqlite3.Error as error:
            answer = str(error).replace("\n", " ")
        print(answer, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
