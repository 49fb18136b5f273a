"""`groundstation keys`: an authority, folders that are whole or not there, and nothing ever overwritten."""

from __future__ import annotations

import json
import shutil
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from trueflight.groundstation.commands.app import app
from trueflight.groundstation.operate.keys import make_keys
from trueflight.models.access import may, read_keys
from trueflight.models.errors import InputError, run_command_line


def run(capsys, *arguments):
    code = 0
    try:
        run_command_line(lambda: app([str(a) for a in arguments], standalone_mode=False))
    except SystemExit as stopped:
        code = stopped.code
    told = capsys.readouterr()
    return code, told.out, told.err


def test_one_command_makes_everything_and_says_what_to_copy_where(tmp_path, capsys):
    root = tmp_path / "keys"
    code, out, _ = run(
        capsys, "keys", root, "--vehicle", "quad5", "--engineer", "anna", "--observer", "eve", "--json"
    )
    told = json.loads(out)
    assert code == 0 and told["new_authority"]
    assert [Path(path).name for path in told["made"]] == ["vehicle-quad5", "eve", "anna"]
    assert any("scp -r" in step and "vehicle-quad5" in step for step in told["next"])
    for folder in told["made"]:
        assert stat.S_IMODE(Path(folder).stat().st_mode) == 0o700
        for path in Path(folder).glob("*key.pem"):
            assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE((root / "ca" / "ca-key.pem").stat().st_mode) == 0o600
    assert (root / "anna" / "signing-key.pem").exists() and not (root / "eve" / "signing-key.pem").exists()
    vehicle = read_keys(root / "vehicle-quad5")
    assert {(one.name, one.role, bool(one.signing_key)) for one in vehicle.people} == {
        ("anna", "engineer", True),
        ("eve", "observer", False),
    }
    assert not list(root.rglob("*.part"))


def test_certificates_say_who_for_how_long_and_for_what(tmp_path):
    root = tmp_path / "keys"
    make_keys(root, ["quad5"], [("anna", "operator")], days=30)
    vehicle, anna = (
        x509.load_pem_x509_certificate((root / name / "cert.pem").read_bytes())
        for name in ("vehicle-quad5", "anna")
    )
    authority = x509.load_pem_x509_certificate((root / "ca" / "ca.pem").read_bytes())
    assert vehicle.subject.rfc4514_string() == "CN=quad5.vehicle"
    assert anna.subject.rfc4514_string() == "CN=anna.operator"
    for one, use in (
        (vehicle, ExtendedKeyUsageOID.SERVER_AUTH),
        (anna, ExtendedKeyUsageOID.CLIENT_AUTH),
    ):
        one.verify_directly_issued_by(authority)
        days = (one.not_valid_after_utc - one.not_valid_before_utc).days
        assert 30 <= days <= 33
        assert list(one.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value) == [use]
        assert not one.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


def test_nothing_is_overwritten_and_somebody_can_be_added_later(tmp_path, capsys):
    root = tmp_path / "keys"
    make_keys(root, ["quad5"], [("anna", "operator")])
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    code, _, err = run(capsys, "keys", root, "--operator", "carl", "--operator", "anna")
    assert code == 2 and err.count("\n") == 1 and "anna" in err and "not overwritten" in err
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before
    code, out, _ = run(capsys, "keys", root, "--operator", "carl")
    assert code == 0 and "access.toml" in out and "carl" in out
    assert [one.name for one in read_keys(root / "vehicle-quad5").people] == ["anna", "carl"]
    changed = {path for path in before if path.read_bytes() != before[path]}
    assert {path.name for path in changed} == {"access.toml", "issued.json"}


def test_who_is_removed_is_let_in_no_longer_also_not_by_new_keys_of_the_same_name(tmp_path):
    root = tmp_path / "keys"
    make_keys(root, ["quad5"], [("anna", "operator")])
    make_keys(root, people=[("anna", "operator")], removed=["anna"])
    (anna,) = read_keys(root / "vehicle-quad5").people
    assert anna.certificate == "anna.operator.2", "the lost certificate has another name"
    make_keys(root, removed=["anna"])
    assert read_keys(root / "vehicle-quad5").people == ()
    assert not (root / "anna").exists()


BAD = {
    "nobody": ([], "keys for whom"),
    "path": (["--operator", "../anna"], "letters, digits"),
    "key": (["--vehicle", "quad/5"], "letters, digits"),
    "wildcard": (["--vehicle", "*"], "letters, digits"),
    "authority": (["--operator", "ca"], "something else"),
    "twice": (["--operator", "anna", "--observer", "anna"], "twice"),
    "unknown": (["--remove", "anna"], "has no keys here"),
    "for ever": (["--operator", "anna", "--days", "1e9"], "--days"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_request_is_one_line_and_leaves_nothing(case, tmp_path, capsys):
    arguments, words = BAD[case]
    code, out, err = run(capsys, "keys", tmp_path / "keys", *arguments)
    assert code == 2 and out == "" and err.count("\n") == 1 and words in err
    assert not (tmp_path / "keys").exists()


@pytest.mark.parametrize(
    ("file", "content"),
    [("issued.json", "["), ("issued.json", '{"anna": 3}'), ("ca.pem", ""), ("ca-key.pem", "nonsense")],
)
def test_a_damaged_authority_is_told(file, content, tmp_path):
    root = tmp_path / "keys"
    make_keys(root, ["quad5"])
    (root / "ca" / file).write_text(content)
    with pytest.raises(InputError, match="groundstation keys"):
        make_keys(root, people=[("anna", "operator")])
    assert not (root / "anna").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda folder: (folder / "key.pem").unlink(), "cannot read key.pem"),
        (lambda folder: (folder / "key.pem").chmod(0o644), "chmod 600"),
        (lambda folder: (folder / "access.toml").write_text("[own"), "not valid TOML"),
        (lambda folder: (folder / "access.toml").write_bytes(b"\xff\xfe"), "not text in UTF-8"),
        (lambda folder: (folder / "access.toml").write_text("x = 1"), r"no section \[own\]"),
        (lambda folder: (folder / "access.toml").write_text("[own]\nname = 3"), "must be a text"),
        (lambda folder: shutil.rmtree(folder), "cannot read ca.pem"),
    ],
)
def test_a_folder_that_cannot_be_used_is_told(change, words, tmp_path):
    make_keys(tmp_path / "keys", ["quad5"])
    folder = tmp_path / "keys" / "vehicle-quad5"
    change(folder)
    with pytest.raises(InputError, match=words):
        read_keys(folder)


def test_each_role_has_the_rights_of_those_before_it():
    assert [leaf for leaf in ("tick", "record", "mission", "model") if may("observer", leaf)] == [
        "tick",
        "record",
    ]
    assert may("operator", "mission") and not may("operator", "model")
    assert may("engineer", "model") and may("engineer", "pose")
    assert not any(may(role, "anything") for role in ("observer", "operator", "engineer"))
    assert not may("vehicle", "tick")
