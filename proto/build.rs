//! Compiles the .proto files with protox (no protoc to install) into messages, servers, clients and one descriptor set.

use prost_reflect::{DescriptorPool, MethodDescriptor, ReflectMessage, Value};
use std::fmt::Write;
use std::path::PathBuf;

const FILES: [&str; 22] = [
    "midshift/common/v1/access.proto",
    "midshift/common/v1/common.proto",
    "midshift/common/v1/privacy.proto",
    "midshift/task/v1/task.proto",
    "midshift/task/v1/task_service.proto",
    "midshift/fleet/v1/fleet.proto",
    "midshift/fleet/v1/fleet_service.proto",
    "midshift/identity/v1/audit_service.proto",
    "midshift/identity/v1/enrolment_service.proto",
    "midshift/identity/v1/identity_service.proto",
    "midshift/link/v1/link.proto",
    "midshift/link/v1/replay_service.proto",
    "midshift/link/v1/update.proto",
    "midshift/ota/v1/bundle_service.proto",
    "midshift/ota/v1/rollout.proto",
    "midshift/ota/v1/rollout_service.proto",
    "midshift/stop/v1/stop.proto",
    "midshift/stop/v1/stop_link_service.proto",
    "midshift/stop/v1/stop_service.proto",
    "midshift/telemetry/v1/telemetry.proto",
    "midshift/telemetry/v1/telemetry_service.proto",
    "midshift/sim/v1/sim_service.proto",
];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    println!("cargo:rerun-if-changed=midshift");
    let mut compiler = protox::Compiler::new(["."])?;
    // Comments stay in: reflection shows them, and a test holds them against the rules of core.
    compiler.include_source_info(true).include_imports(true).open_files(FILES)?;
    let set = compiler.file_descriptor_set();
    let out = PathBuf::from(std::env::var("OUT_DIR")?);
    // Encoded by protox itself: prost's types forget options that they do not know.
    let encoded = compiler.encode_file_descriptor_set();
    std::fs::write(out.join("access.rs"), access(&DescriptorPool::decode(encoded.as_slice())?)?)?;
    std::fs::write(out.join("descriptor_set.bin"), encoded)?;
    let mut config = tonic_prost_build::Config::new();
    config.enable_type_names();
    tonic_prost_build::configure().btree_map(".").compile_fds_with_config(set, config)?;
    Ok(())
}

/// The rule of each method, by its path, as arms of a match. A method that states none has none.
fn access(pool: &DescriptorPool) -> Result<String, Box<dyn std::error::Error>> {
    let option = pool.get_extension_by_name("midshift.common.v1.access").ok_or("the option is not declared")?;
    let mut arms = String::from("match path {\n");
    for method in pool.services().flat_map(|service| service.methods().collect::<Vec<_>>()) {
        let options = method.options();
        if !options.has_extension(&option) {
            continue;
        }
        let rule = options.get_extension(&option);
        let rule = rule.as_message().ok_or("the option is a message")?;
        let word = |field: &str, prefix: &str| -> Result<String, String> {
            let value = rule.get_field_by_name(field).map(std::borrow::Cow::into_owned);
            variant(&method, rule, field, value.as_ref(), prefix)
        };
        let (permission, object) = (word("permission", "PERMISSION_")?, word("object", "OBJECT_")?);
        let path = format!("/{}/{}", method.parent_service().full_name(), method.name());
        writeln!(
            arms,
            "{path:?} => Some(Access {{ permission: Permission::{permission}, object: Object::{object} }}),"
        )?;
    }
    arms.push_str("_ => None,\n}\n");
    Ok(arms)
}

/// `PERMISSION_SIGNED_IN` as core names it: `SignedIn`.
fn variant(
    method: &MethodDescriptor,
    rule: &prost_reflect::DynamicMessage,
    field: &str,
    value: Option<&Value>,
    prefix: &str,
) -> Result<String, String> {
    let bad = || format!("{}: {field} of its access is not stated", method.full_name());
    let number = value.and_then(Value::as_enum_number).filter(|number| *number != 0).ok_or_else(bad)?;
    let kind = rule.descriptor().get_field_by_name(field).map(|field| field.kind()).ok_or_else(bad)?;
    let word = kind.as_enum().and_then(|words| words.get_value(number)).ok_or_else(bad)?;
    let name = word.name().trim_start_matches(prefix).to_lowercase();
    let capital = |part: &str| part[..1].to_uppercase() + &part[1..];
    Ok(name.split('_').map(capital).collect())
}
