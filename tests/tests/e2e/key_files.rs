//! Key files of release people in other hands: OpenSSL, Python, Node.js and Go sign with them, and what OpenSSL makes is a key here.
//!
//! ed25519 has one signature for a key and a text, so all must come to the same.

use crate::clients::text;
use crate::harness::{command, tool};
use crate::languages::Language;
use crate::secrets::heard;
use anyhow::ensure;
use midshift_bundle::keys::{PublicKey, SecretKey, hex};
use std::path::Path;
use std::process::Command;

/// What each signs.
const TEXT: &str = "who signs this has the key";
/// Prints the signature of TEXT in hexadecimal digits: `python -c PYTHON KEY TEXT`.
const PYTHON: &str = "
import sys
from cryptography.hazmat.primitives.serialization import load_pem_private_key
with open(sys.argv[1], 'rb') as file:
    key = load_pem_private_key(file.read(), None)
print(key.sign(sys.argv[2].encode()).hex())
";
/// The same: `node -e NODE KEY TEXT`.
const NODE: &str = "
const crypto = require('crypto');
const key = crypto.createPrivateKey(require('fs').readFileSync(process.argv[1]));
console.log(crypto.sign(null, Buffer.from(process.argv[2]), key).toString('hex'));
";

fn printed(command: &mut Command) -> anyhow::Result<String> {
    let done = command.output()?;
    ensure!(done.status.success(), "{command:?}: {}", text(&done.stderr));
    Ok(text(&done.stdout).trim().to_owned())
}

fn openssl(dir: &Path, arguments: &[&str]) -> anyhow::Result<String> {
    printed(Command::new(tool("MIDSHIFT_TEST_OPENSSL")?).args(arguments).current_dir(dir))
}

#[test]
fn openssl_python_node_and_go_sign_with_our_keys_and_a_key_of_openssl_is_one_of_ours() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let dir = dir.path();
    let made = heard(command(&["bundle", "keygen", "--keys", "keys", "--repository", "repository"])?.current_dir(dir))?;
    ensure!(made.status.success(), "{}", text(&made.stderr));
    let file = dir.join("keys/targets-1.pem");
    let key = SecretKey::read(&file)?;
    let signature = hex(&key.sign(TEXT.as_bytes()));
    std::fs::write(dir.join("text"), TEXT)?;
    openssl(dir, &["pkeyutl", "-sign", "-rawin", "-inkey", "keys/targets-1.pem", "-in", "text", "-out", "signature"])?;
    assert_eq!(hex(&std::fs::read(dir.join("signature"))?), signature, "OpenSSL");
    let python = printed(Command::new(tool("MIDSHIFT_TEST_PYTHON")?).args(["-c", PYTHON]).arg(&file).arg(TEXT))?;
    assert_eq!(python, signature, "Python");
    let node = printed(Command::new(tool("MIDSHIFT_TEST_NODE")?).args(["-e", NODE]).arg(&file).arg(TEXT))?;
    assert_eq!(node, signature, "Node.js");
    assert_eq!(printed(&mut Language::Go.signs(&file, TEXT)?)?, signature, "Go");

    openssl(dir, &["pkey", "-in", "keys/targets-1.pem", "-pubout", "-out", "public.pem"])?;
    assert_eq!(PublicKey::read(&dir.join("public.pem"))?, key.public());
    openssl(dir, &["genpkey", "-algorithm", "ed25519", "-out", "theirs.pem"])?;
    openssl(dir, &["pkey", "-in", "theirs.pem", "-pubout", "-out", "theirs.public.pem"])?;
    assert_eq!(SecretKey::read(&dir.join("theirs.pem"))?.public(), PublicKey::read(&dir.join("theirs.public.pem"))?);
    Ok(())
}
