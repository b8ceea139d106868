//! A client of TUF that is not ours, python-tuf, on a real server: it takes what people signed and nothing else.
//!
//! The lies are told by a small server between the two, some of them with keys that a thief has, and on the disk of ours.
//! The attacks have the names that the TUF specification gives them in its security goals.

use crate::harness::{Server, command, sign_in, tool};
use crate::secrets::heard;
use midshift_core::site::DEMO;
use std::path::Path;
use std::process::Command;

/// A robot that trusts python-tuf, and a liar: `python robot.py PART SERVER ROOT WORK`.
const CLIENT: &str = r#"
import datetime, os, ssl, sys, threading, urllib.error, urllib.request
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from securesystemslib.signer import CryptoSigner
from tuf.api import exceptions
from tuf.api.metadata import Metadata, MetaFile, TargetFile
from tuf.ngclient import FetcherInterface, Updater

part, server, root, work = sys.argv[1:]
lies = {}
site = ssl.create_default_context(cafile=os.environ["MIDSHIFT_CA"])

def ask(url):
    signed_in = {"Authorization": "Bearer " + os.environ["MIDSHIFT_TOKEN"]} if url.startswith(server) else {}
    with urllib.request.urlopen(urllib.request.Request(url, headers=signed_in), context=site) as answer:
        return answer.read()

class SignedIn(FetcherInterface):
    def _fetch(self, url):
        try:
            return iter([ask(url)])
        except urllib.error.HTTPError as error:
            raise exceptions.DownloadHTTPError(str(error), error.code) from error

def get(name):
    return ask(f"{server}/metadata/{name}")

class Between(BaseHTTPRequestHandler):
    def do_GET(self):
        name = self.path.rsplit("/", 1)[1]
        code, body = 200, lies.get(name)
        if body is None:
            try:
                body = ask(server + self.path)
            except urllib.error.HTTPError as error:
                code, body = error.code, b""
        self.send_response(code)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass

liar = ThreadingHTTPServer(("127.0.0.1", 0), Between)
threading.Thread(target=liar.serve_forever, daemon=True).start()
between = f"http://127.0.0.1:{liar.server_port}"

def client(name, base=server):
    folder = os.path.join(work, name)
    for sub in ("metadata", "targets"):
        os.makedirs(os.path.join(folder, sub), exist_ok=True)
    with open(root, "rb") as file:
        first = file.read()
    return Updater(f"{folder}/metadata", f"{base}/metadata/", f"{folder}/targets", f"{base}/targets/",
                   fetcher=SignedIn(), bootstrap=first)

def download(updater, name):
    found = updater.get_targetinfo(name)
    assert found is not None, name
    with open(updater.download_target(found), "rb") as file:
        return file.read()

def refused(attack, error, call):
    try:
        call()
    except error:
        print(f"refused: {attack}")
    else:
        sys.exit(f"{attack} was taken")

def keep(name):
    with open(os.path.join(work, name), "wb") as file:
        file.write(get(name))

def kept(name):
    with open(os.path.join(work, name), "rb") as file:
        return file.read()

def signer(role):
    with open(root, "rb") as file:
        first = Metadata.from_bytes(file.read()).signed
    with open(f"keys/{role}-1.pem", "rb") as file:
        secret = load_pem_private_key(file.read(), None)
    return CryptoSigner(secret, first.keys[first.roles[role].keyids[0]])

def later(signed):
    signed.version += 1

def lasting(signed):
    later(signed)
    signed.expires = datetime.datetime.now(datetime.timezone.utc) + datetime.timedelta(days=30)

def forward(signed):
    signed.version = 1_000_000

def forged(name, by, change=later):
    document = Metadata.from_bytes(get(name))
    change(document.signed)
    document.sign(by)
    return document.to_bytes()

def newest():
    snapshot = Metadata.from_bytes(get("timestamp.json")).signed.snapshot_meta.version
    return snapshot, Metadata.from_bytes(get(f"{snapshot}.snapshot.json")).signed.meta["targets.json"].version

def stamp(snapshot, version, change=later):
    def name_it(signed):
        change(signed)
        signed.snapshot_meta = MetaFile.from_data(version, snapshot, ["sha256"])
    lies[f"{version}.snapshot.json"] = snapshot
    lies["timestamp.json"] = forged("timestamp.json", signer("timestamp"), name_it)

def snap(targets, version):
    at, _ = newest()
    def name_them(signed):
        later(signed)
        signed.meta["targets.json"] = MetaFile.from_data(version, targets, ["sha256"])
    lies[f"{version}.targets.json"] = targets
    stamp(forged(f"{at}.snapshot.json", signer("snapshot"), name_them), at + 1)

def attacked(attack, error):
    client(attack).refresh()
    refused(attack, error, client(attack, between).refresh)
    lies.clear()

if part == "first":
    robot = client("robot")
    robot.refresh()
    assert download(robot, "gait-1.5.0.component") == b"walks"
    assert b'"name": "walk"' in download(robot, "walk-1.5.0.manifest")
    assert robot.get_targetinfo("gait-6.6.6.component") is None
    for name in ("timestamp.json", "1.snapshot.json", "1.targets.json"):
        keep(name)
elif part == "second":
    robot = client("robot")
    robot.refresh()
    assert download(robot, "gait-1.6.0.component") == b"runs"
    lies["timestamp.json"] = kept("timestamp.json")
    refused("a timestamp that was rolled back", exceptions.BadVersionNumberError, client("robot", between).refresh)
    lies.clear()
    lies["2.snapshot.json"] = kept("1.snapshot.json")
    refused("a snapshot of another release", exceptions.RepositoryError, client("mixed", between).refresh)
    lies.clear()
    lies["2.targets.json"] = kept("1.targets.json")
    refused("targets of another release", exceptions.RepositoryError, client("mixed", between).refresh)
    lies.clear()
    lies["2.targets.json"] = get("2.targets.json").replace(b"1.6.0", b"6.6.6")
    refused("targets that were tampered with", exceptions.RepositoryError, client("mixed", between).refresh)
    lies.clear()
    lies["2.root.json"] = get("1.root.json")
    refused("a root that is not the next", exceptions.BadVersionNumberError, client("mixed", between).refresh)
    lies.clear()
    lies["timestamp.json"] = get("timestamp.json") + b" " * 100_000
    refused("a timestamp without an end", exceptions.DownloadError, client("mixed", between).refresh)
    lies.clear()
    client("mixed", between).refresh()
    frozen = client("frozen")
    frozen._trusted_set.reference_time = datetime.datetime.now(datetime.timezone.utc) + datetime.timedelta(days=2)
    refused("a timestamp that was frozen", exceptions.ExpiredMetadataError, frozen.refresh)
    client("frozen").refresh()
elif part == "thief":
    stranger = CryptoSigner.generate_ed25519()
    snapshot, targets = newest()
    def seized(signed):
        later(signed)
        for role in ("root", "targets", "snapshot", "timestamp"):
            signed.add_key(stranger.public_key, role)
    def evil(signed):
        later(signed)
        signed.targets["gait-6.6.6.component"] = TargetFile.from_data("gait-6.6.6.component", b"evil")
    unsigned = exceptions.UnsignedMetadataError
    lies["2.root.json"] = forged("1.root.json", stranger, seized)
    attacked("a root by a key of no role", unsigned)
    lies["timestamp.json"] = forged("timestamp.json", stranger)
    attacked("a timestamp by a key of no role", unsigned)
    stamp(forged(f"{snapshot}.snapshot.json", stranger), snapshot + 1)
    attacked("a snapshot by a key of no role", unsigned)
    snap(forged(f"{targets}.targets.json", stranger, evil), targets + 1)
    attacked("targets by a key of no role", unsigned)
    snap(forged(f"{targets}.targets.json", signer("snapshot"), evil), targets + 1)
    attacked("targets by a key of another role", unsigned)
    stamp(kept("1.snapshot.json"), 1)
    attacked("a snapshot that was rolled back", exceptions.BadVersionNumberError)
    snap(kept("1.targets.json"), 1)
    attacked("targets that were rolled back", exceptions.BadVersionNumberError)
    stamp(get(f"{snapshot}.snapshot.json"), snapshot, lasting)
    frozen = client("a snapshot that was frozen", between)
    frozen._trusted_set.reference_time = datetime.datetime.now(datetime.timezone.utc) + datetime.timedelta(days=8)
    refused("a snapshot that was frozen", exceptions.ExpiredMetadataError, frozen.refresh)
    lies.clear()
    robot = client("robot", between)
    robot.refresh()
    name = "gait-1.6.0.component"
    lies[f"{robot.get_targetinfo(name).hashes['sha256']}.{name}"] = b"runs" * 100_000
    refused("a file without an end", exceptions.DownloadError, lambda: download(robot, name))
    lies[f"{robot.get_targetinfo(name).hashes['sha256']}.{name}"] = b"evil"
    refused("another file", exceptions.RepositoryError, lambda: download(robot, name))
    lies.clear()
    assert download(robot, name) == b"runs"
    stamp(forged(f"{snapshot}.snapshot.json", signer("snapshot"), forward), 1_000_000, forward)
    client("driven").refresh()
    client("driven", between).refresh()
    lies.clear()
    refused("what is honest after a fast-forward", exceptions.BadVersionNumberError, client("driven").refresh)
elif part == "rotated":
    driven = client("driven")
    driven.refresh()
    assert download(driven, "gait-1.6.0.component") == b"runs"
    lies["timestamp.json"] = forged("timestamp.json", signer("timestamp"))
    refused("a timestamp by a key that was stolen", exceptions.UnsignedMetadataError, client("driven", between).refresh)
    lies.clear()
    client("driven", between).refresh()
elif part == "tampered":
    robot = client("late")
    robot.refresh()
    assert download(robot, "gait-1.5.0.component") == b"walks"
    refused("a file that was tampered with", exceptions.RepositoryError, lambda: download(robot, "gait-1.6.0.component"))
elif part == "follows":
    robot = client("robot")
    robot.refresh()
    download(robot, "gait-1.0.0.component")
    believed = robot._trusted_set
    print(f"root {believed.root.version}, targets {believed.targets.version}")
"#;

/// Runs the program in `dir` and wants it to succeed.
fn release(dir: &Path, arguments: &[&str]) -> anyhow::Result<()> {
    let done = heard(command(arguments)?.current_dir(dir))?;
    anyhow::ensure!(done.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&done.stderr));
    Ok(())
}

/// A folder to build a bundle of one component of; its name.
pub fn draft(dir: &Path, version: &str, content: &str) -> anyhow::Result<String> {
    let draft = format!(
        "name = \"walk\"\nversion = \"{version}\"\n[[component]]\nname = \"gait\"\nversion = \"{version}\"\nkind = \"process\"\n\
         file = \"gait\"\nhardware = [\"h1\"]\nneeds = \"restart\"\n"
    );
    let folder = format!("draft-{version}");
    std::fs::create_dir(dir.join(&folder))?;
    std::fs::write(dir.join(&folder).join("bundle.toml"), draft)?;
    std::fs::write(dir.join(&folder).join("gait"), content)?;
    Ok(folder)
}

/// Builds and signs a bundle of one component, and brings it to the server.
fn push(dir: &Path, server: &Server, version: &str, content: &str) -> anyhow::Result<()> {
    let (folder, bundle) = (draft(dir, version, content)?, format!("walk-{version}"));
    release(dir, &["bundle", "build", &folder, "--out", &bundle])?;
    release(dir, &["bundle", "sign", &bundle, "--repository", "repository", "--key", "keys/targets-1.pem"])?;
    release(dir, &["bundle", "push", "repository", "--server", &server.address.to_string()])
}

/// What python-tuf says, which keeps what it believes in `work` and began with the first root of `repository`.
pub fn python(dir: &Path, server: &Server, part: &str, repository: &str) -> anyhow::Result<Vec<String>> {
    let script = dir.join("robot.py");
    std::fs::write(&script, CLIENT)?;
    let mut command = Command::new(tool("MIDSHIFT_TEST_PYTHON")?);
    command.arg(&script).args([
        part,
        &format!("https://{}", server.address),
        &format!("{repository}/metadata/1.root.json"),
        "work",
    ]);
    sign_in(&mut command, server.address);
    let ran = command.current_dir(dir).output()?;
    anyhow::ensure!(ran.status.success(), "{part}: {}", String::from_utf8_lossy(&ran.stderr));
    Ok(String::from_utf8(ran.stdout)?.lines().map(str::to_owned).collect())
}

/// Other keys for the server, as if its own had been stolen: the root names them, and it signs with them.
async fn change_keys(dir: &Path, server: &mut Server) -> anyhow::Result<()> {
    for role in ["snapshot", "timestamp"] {
        let (old, new) = (format!("keys/{role}-1.pem"), format!("keys/{role}-2.pem"));
        let rotate = ["bundle", "root", "rotate", "--repository", "repository", "--role", role];
        release(dir, &[&rotate[..], &["--drop", &old, "--key", &new]].concat())?;
    }
    release(dir, &["bundle", "root", "sign", "--repository", "repository", "--key", "keys/root-1.pem"])?;
    // It reads keys when it starts.
    server.kill_and_restart().await?;
    release(dir, &["bundle", "sign", "--renew", "--repository", "repository", "--key", "keys/targets-1.pem"])?;
    release(dir, &["bundle", "push", "repository", "--server", &server.address.to_string()])
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn python_tuf_takes_releases_and_refuses_each_attack() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let dir = dir.path();
    release(dir, &["bundle", "keygen", "--keys", "keys", "--repository", "repository"])?;
    let keys = dir.join("keys");
    let mut server = Server::start_with(dir, DEMO, &["--ota-keys", &keys.to_string_lossy()]).await?;
    push(dir, &server, "1.5.0", "walks")?;
    std::fs::create_dir(dir.join("work"))?;
    assert_eq!(python(dir, &server, "first", "repository")?, Vec::<String>::new());
    server.kill_and_restart().await?;
    push(dir, &server, "1.6.0", "runs")?;
    let refused = [
        "refused: a timestamp that was rolled back",
        "refused: a snapshot of another release",
        "refused: targets of another release",
        "refused: targets that were tampered with",
        "refused: a root that is not the next",
        "refused: a timestamp without an end",
        "refused: a timestamp that was frozen",
    ];
    assert_eq!(python(dir, &server, "second", "repository")?, refused);
    let refused = [
        "refused: a root by a key of no role",
        "refused: a timestamp by a key of no role",
        "refused: a snapshot by a key of no role",
        "refused: targets by a key of no role",
        "refused: targets by a key of another role",
        "refused: a snapshot that was rolled back",
        "refused: targets that were rolled back",
        "refused: a snapshot that was frozen",
        "refused: a file without an end",
        "refused: another file",
        "refused: what is honest after a fast-forward",
    ];
    assert_eq!(python(dir, &server, "thief", "repository")?, refused);
    change_keys(dir, &mut server).await?;
    assert_eq!(python(dir, &server, "rotated", "repository")?, ["refused: a timestamp by a key that was stolen"]);
    let content = dir.join("data/ota/content");
    let mut tampered = 0;
    for entry in std::fs::read_dir(content)? {
        let path = entry?.path();
        if std::fs::read(&path)? == b"runs" {
            std::fs::write(path, "ruts")?;
            tampered += 1;
        }
    }
    assert_eq!(tampered, 1);
    assert_eq!(python(dir, &server, "tampered", "repository")?, ["refused: a file that was tampered with"]);
    Ok(())
}
