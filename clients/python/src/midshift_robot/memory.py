"""What must survive a restart, in files. Nothing that depends on it leaves, and nothing moves on it, before `save` came back."""

import json
import os
import pathlib


class Memory:
    """One file. A stop has another one than the work: neither waits for the other to be readable."""

    def __init__(self, path: pathlib.Path, first: dict) -> None:
        self.path = path
        self.dirty = True
        self.row = first
        if path.exists():
            self.row.update(json.loads(path.read_text()))

    def save(self) -> None:
        if not self.dirty:
            return
        new = self.path.with_suffix(self.path.suffix + ".new")
        # The key of the machine may be in there.
        with open(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
            json.dump(self.row, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, self.path)
        folder = os.open(self.path.parent, os.O_RDONLY)
        os.fsync(folder)
        os.close(folder)
        self.dirty = False

    def __getitem__(self, key: str):
        return self.row[key]

    def __setitem__(self, key: str, value) -> None:
        self.row[key] = value
        self.dirty = True
