"""Keys are shown once, stored as hashes in a file of mode 0600, and end by revocation and expiry."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hal.errors import ConfigError, InvalidRequest
from service.access import keys
from service.access.keys import KeyBook, Role, key_from_file
from service.access.sessions import SESSION_S, Sessions
from service.cli import _app
from service.errors import JournalError, KeysUnusable
from service.tasks.journal_reader import read_records


class Book:
    """A file of keys with a clock and a journal that tests set."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "keys.json"
        self.now_s = 1000.0
        self.told: list[tuple[str, dict[str, Any]]] = []
        self.book = KeyBook(self.path, now=lambda: self.now_s)

    def add(self, name: str, role: Role = Role.OPERATOR, valid_s: float | None = None) -> str:
        return self.book.add(name, role, valid_s=valid_s, commit=lambda *row: self.told.append(row))

    def revoke(self, name: str) -> None:
        self.book.revoke(name, commit=lambda *row: self.told.append(row))


@pytest.fixture
def kept(tmp_path: Path) -> Book:
    return Book(tmp_path)


def test_a_key_is_stored_as_its_hash_in_a_file_of_its_user(kept: Book) -> None:
    secret = kept.add("alice")
    assert len(secret) >= 40 and secret not in kept.path.read_text()
    assert hashlib.sha256(secret.encode()).hexdigest() in kept.path.read_text()
    assert kept.path.stat().st_mode & 0o777 == 0o600
    found = kept.book.find(secret)
    assert found is not None and (found.name, found.role) == ("alice", Role.OPERATOR)
    assert kept.book.find(secret + "x") is None and kept.book.find("") is None


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o777])
def test_a_file_that_others_may_access_is_refused(kept: Book, mode: int) -> None:
    secret = kept.add("alice")
    kept.path.chmod(mode)
    with pytest.raises(KeysUnusable, match="other users"):
        kept.book.find(secret)


def test_a_key_expires_and_can_be_revoked(kept: Book) -> None:
    short, lasting = kept.add("alice", valid_s=60.0), kept.add("bob")
    kept.now_s += 60.0
    assert kept.book.find(short) is None and kept.book.find(lasting) is not None
    kept.revoke("bob")
    assert kept.book.find(lasting) is None
    assert not kept.book.is_open, "a service whose keys have all ended is closed, not open"
    with pytest.raises(InvalidRequest, match="no active key"):
        kept.revoke("bob")


def test_a_request_is_judged_by_the_file_as_it_was_at_one_moment(kept: Book) -> None:
    secret = kept.add("alice")

    class Counted(type(kept.path)):  # type: ignore[misc]
        asked = 0

        def stat(self, *, follow_symlinks: bool = True) -> Any:
            Counted.asked += 1
            return super().stat(follow_symlinks=follow_symlinks)

    kept.book.path = Counted(kept.path)
    keys = kept.book.now()
    kept.path.unlink()
    assert not keys.is_open and keys.find(secret) is not None and keys.named("alice") is not None
    assert Counted.asked == 1


def test_a_change_by_another_process_counts_at_once(kept: Book) -> None:
    secret = kept.add("alice")
    assert kept.book.find(secret) is not None
    KeyBook(kept.path).revoke("alice", commit=lambda *_row: None)
    assert kept.book.find(secret) is None


def test_a_stream_is_told_of_changes_by_its_own_service_at_once_and_by_others_a_moment_later(
    kept: Book, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keys, "RECENT_S", 60.0)
    kept.add("alice")
    kept.add("bob")
    before = kept.book.recent()
    kept.revoke("bob")
    after = kept.book.recent()
    assert before.named("bob") is not None and after.named("bob") is None
    KeyBook(kept.path).revoke("alice", commit=lambda *_row: None)
    assert kept.book.recent() is after
    monkeypatch.setattr(keys, "RECENT_S", -1.0)
    assert kept.book.recent().named("alice") is None


def test_a_deleted_or_damaged_file_closes_the_service(kept: Book) -> None:
    secret = kept.add("alice")
    kept.book.find(secret)
    text = kept.path.read_text()
    kept.path.write_text(text.replace("operator", "god"))
    with pytest.raises(KeysUnusable, match="cannot be read"):
        kept.book.find(secret)
    kept.path.unlink()
    with pytest.raises(KeysUnusable, match="deleted"):
        kept.book.find(secret)


def test_a_key_is_recorded_before_it_is_valid(kept: Book) -> None:
    kept.add("alice", Role.OBSERVER)
    kept.revoke("alice")
    assert [kind for kind, _ in kept.told] == ["key-added", "key-revoked"]
    assert "sha" not in json.dumps(kept.told)

    def full(_kind: str, _data: dict[str, Any]) -> None:
        raise JournalError("the disk is full", hint="free space")

    with pytest.raises(JournalError):
        kept.book.add("bob", Role.OPERATOR, valid_s=None, commit=full)
    assert kept.book.named("bob") is None


@pytest.mark.parametrize("name", ["", "../x", "a b", "ä", "x" * 65, "<b>", "this-program"])
def test_a_name_is_plain(kept: Book, name: str) -> None:
    with pytest.raises(InvalidRequest):
        kept.add(name)


def test_a_name_belongs_to_one_active_key(kept: Book) -> None:
    first = kept.add("alice")
    with pytest.raises(InvalidRequest, match="alice"):
        kept.add("alice")
    kept.revoke("alice")
    second = kept.add("alice", Role.OBSERVER)
    assert kept.book.find(first) is None and kept.book.find(second) is not None


def test_a_program_has_one_key_of_its_own_that_is_stored_nowhere(kept: Book) -> None:
    own = kept.book.own()
    assert kept.book.is_open, "it does not close an open service"
    kept.add("alice")
    found = kept.book.find(own)
    assert found is not None and found.role is Role.MAINTAINER and kept.book.own() == own
    assert KeyBook(kept.path).find(own) is None
    assert [key.name for key in kept.book.all()] == ["alice"]


def test_roles_are_ordered() -> None:
    order = [Role.OBSERVER, Role.OPERATOR, Role.MAINTAINER]
    for have in order:
        assert [have.permits(need) for need in order] == [order.index(need) <= order.index(have) for need in order]


def test_a_session_ends_with_its_time_and_with_its_key(kept: Book) -> None:
    now_s = [0.0]
    sessions = Sessions(now=lambda: now_s[0])
    kept.add("alice")
    key = kept.book.named("alice")
    assert key is not None
    token, other = sessions.open(key), sessions.open(key)
    assert sessions.find(token, kept.book.now()) == key and sessions.find("x", kept.book.now()) is None
    sessions.close(other)
    assert sessions.find(other, kept.book.now()) is None
    kept.revoke("alice")
    kept.add("alice")
    assert sessions.find(token, kept.book.now()) is None, "another key of the same name is another key"
    fresh = kept.book.named("alice")
    assert fresh is not None
    token = sessions.open(fresh)
    now_s[0] = SESSION_S
    assert sessions.find(token, kept.book.now()) is None


def test_a_key_file_of_a_client_is_its_users_alone(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_text("pw_abc\n")
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="other users"):
        key_from_file(path)
    path.chmod(0o600)
    assert key_from_file(path) == "pw_abc"
    path.write_text("\n")
    with pytest.raises(ConfigError, match="empty"):
        key_from_file(path)


def test_the_key_file_of_one_command_is_not_used_by_the_next(tmp_path: Path) -> None:
    runner, app = CliRunner(), _app()
    with_file = runner.invoke(
        app, ["--key-file", str(tmp_path / "gone.key"), "task", "list", "--url", "http://127.0.0.1:9"]
    )
    assert "gone.key" in with_file.output + str(with_file.exception)
    without = runner.invoke(app, ["task", "list", "--url", "http://127.0.0.1:9"])
    assert "gone.key" not in without.output + str(without.exception)


def test_the_commands_add_list_and_revoke_and_the_journal_has_both(tmp_path: Path) -> None:
    runner, runs, app = CliRunner(), ["--runs", str(tmp_path)], _app()
    done = runner.invoke(app, ["keys", "add", "alice", "--role", "operator", "--valid-for", "90d", *runs])
    assert done.exit_code == 0, done.output
    secret = done.stdout.strip()
    assert KeyBook(tmp_path / ".service/keys.json").find(secret) is not None
    shown = runner.invoke(app, ["keys", "list", *runs]).stdout
    assert "alice" in shown and "operator" in shown and "active" in shown and secret not in shown
    assert runner.invoke(app, ["keys", "revoke", "alice", *runs]).exit_code == 0
    kinds = [record.kind for record in read_records(tmp_path / ".service/journal.sqlite")]
    assert kinds == ["key-added", "key-revoked"]
    assert KeyBook(tmp_path / ".service/keys.json").find(secret) is None
