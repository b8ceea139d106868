//! A repository that another tool made, python-tuf, with keys of ours: it is verified, pushed and served like our own, and a robot installs a release of it.

use crate::clients::text;
use crate::harness::{Server, tool, until};
use crate::robots::enrolment;
use crate::rolled_out::{Robot, begin_rollout, call, done};
use crate::room::LIMIT;
use anyhow::ensure;
use midshift_core::site::DEMO;
use std::path::Path;
use std::process::Command;

/// Signs a built bundle into a new repository: `python maker.py KEYS BUNDLE REPOSITORY`.
const MAKER: &str = r#"
import datetime, os, shutil, sys
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from securesystemslib.signer import CryptoSigner
from tuf.api.metadata import Metadata, Root, TargetFile, Targets

keys, bundle, repository = sys.argv[1:]

def signer(role):
    with open(os.path.join(keys, f"{role}-1.pem"), "rb") as file:
        return CryptoSigner(load_pem_private_key(file.read(), None))

signers = {role: signer(role) for role in ("root", "targets", "snapshot", "timestamp")}
expires = datetime.datetime.now(datetime.timezone.utc).replace(microsecond=0) + datetime.timedelta(days=300)
for folder in ("metadata", "targets"):
    os.makedirs(os.path.join(repository, folder))

def write(name, signed, role):
    document = Metadata(signed)
    document.sign(signers[role])
    document.to_file(os.path.join(repository, "metadata", name))

root = Root(expires=expires)
for role, by in signers.items():
    root.add_key(by.public_key, role)
write("1.root.json", root, "root")
targets = Targets(expires=expires)
for name in os.listdir(bundle):
    path = os.path.join(bundle, name)
    listed = targets.targets[name] = TargetFile.from_file(name, path)
    shutil.copy(path, os.path.join(repository, "targets", f"{listed.hashes['sha256']}.{name}"))
write("1.targets.json", targets, "targets")
"#;

#[tokio::test]
async fn a_repository_that_python_tuf_made_is_pushed_and_served_and_a_robot_installs_from_it() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let (ours, theirs) = (dir.path().join("ours"), dir.path().join("theirs"));
    let (keys, repository) = (theirs.join("keys"), theirs.join("repository"));
    let shown = |path: &Path| path.display().to_string();
    done(&["bundle", "samples", &shown(&ours)])?;
    let unused = shown(&dir.path().join("unused"));
    done(&["bundle", "keygen", "--keys", &shown(&keys), "--repository", &unused])?;
    let mut maker = Command::new(tool("MIDSHIFT_TEST_PYTHON")?);
    maker.args(["-c", MAKER]).arg(&keys).arg(ours.join("bundles/walk-1.5.0")).arg(&repository);
    let made = maker.output()?;
    ensure!(made.status.success(), "{}", text(&made.stderr));
    done(&["bundle", "verify", &shown(&repository)])?;

    let server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &shown(&keys)]).await?;
    let address = server.address.to_string();
    let enrolment = enrolment(server.address, "rbt-01").await?;
    let home = dir.path().join("robot");
    let robot = Robot::launch("rbt-01", "park-1", &home, &theirs, &address, None, enrolment.as_deref())?;
    done(&["bundle", "push", "--server", &address, &shown(&repository)])?;
    until("the robot is known", LIMIT, async || {
        Ok(call(&["robot", "get", "--server", &address, "rbt-01"])?.status.success().then_some(()))
    })
    .await?;
    let all = ["--waves", "rest", "--allow-full-push", "--soak", "0s", "--probation", "1s", "--exposure-tasks", "0"];
    done(&[&["rollout", "create", "--server", &address, "walk-1.5.0"][..], &all].concat())?;
    begin_rollout(&address, "walk-1.5.0")?;
    let waited = call(&["rollout", "wait", "--server", &address, "walk-1.5.0", "--timeout", "120s"])?;
    assert_eq!(waited.status.code(), Some(0), "{}", text(&waited.stderr));
    robot.keeps("1.5.0").await
}
