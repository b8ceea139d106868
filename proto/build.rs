//! Compiles the .proto files with protox (no protoc to install) into messages, servers, clients and one descriptor set.

use prost_reflect::{DescriptorPool, FieldDescriptor, MessageDescriptor, MethodDescriptor, ReflectMessage, Value};
use std::fmt::Write;
use std::path::PathBuf;

const FILES: [&str; 26] = [
    "midshift/common/v1/access.proto",
    "midshift/common/v1/common.proto",
    "midshift/common/v1/privacy.proto",
    "midshift/task/v1/task.proto",
    "midshift/task/v1/task_service.proto",
    "midshift/task/v1/task_type.proto",
    "midshift/fleet/v1/fleet.proto",
    "midshift/fleet/v1/fleet_service.proto",
    "midshift/fleet/v1/place_block.proto",
    "midshift/fleet/v1/plan.proto",
    "midshift/fleet/v1/planner.proto",
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
    let pool = DescriptorPool::decode(encoded.as_slice())?;
    std::fs::write(out.join("access.rs"), access(&pool)?)?;
    std::fs::write(out.join("descriptor_set.bin"), encoded)?;
    let with_secrets = with_secrets(&pool)?;
    std::fs::write(out.join("secrets.rs"), without_secrets(&with_secrets)?)?;
    let mut config = tonic_prost_build::Config::new();
    config.enable_type_names();
    config.skip_debug(with_secrets.iter().map(|message| format!(".{}", message.full_name())));
    let builder = tonic_prost_build::configure().codec_path("crate::codec::SmallCodec").btree_map(".");
    builder.compile_fds_with_config(set, config)?;
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
        let class = word("load_class", "LOAD_CLASS_")?;
        let path = format!("/{}/{}", method.parent_service().full_name(), method.name());
        writeln!(
            arms,
            "{path:?} => Some(Access {{ permission: Permission::{permission}, object: Object::{object}, class: Class::{class} }}),"
        )?;
    }
    arms.push_str("_ => None,\n}\n");
    Ok(arms)
}

/// Messages with a field that proves who somebody is.
fn with_secrets(pool: &DescriptorPool) -> Result<Vec<MessageDescriptor>, Box<dyn std::error::Error>> {
    let ours = pool.all_messages().filter(|message| message.package_name().starts_with("midshift."));
    let mut found = Vec::new();
    for message in ours {
        for field in message.fields() {
            if is_secret(pool, &field)? {
                found.push(message.clone());
                break;
            }
        }
    }
    Ok(found)
}

/// Whether this field is of the class of credentials, by itself or by its message.
fn is_secret(pool: &DescriptorPool, field: &FieldDescriptor) -> Result<bool, Box<dyn std::error::Error>> {
    let option = |name: &str| pool.get_extension_by_name(name).ok_or("the option is not declared");
    let (of_field, of_message) = (option("midshift.common.v1.field_privacy")?, option("midshift.common.v1.privacy")?);
    let message = field.parent_message();
    let (own, whole) = (field.options(), message.options());
    let said = match (own.has_extension(&of_field), whole.has_extension(&of_message)) {
        (true, _) => own.get_extension(&of_field),
        // A message of ours says itself what it is.
        _ if field.kind().as_message().is_some_and(|kind| kind.package_name().starts_with("midshift.")) => {
            return Ok(false);
        }
        (false, true) => whole.get_extension(&of_message),
        (false, false) => return Ok(false),
    };
    let class =
        said.as_message().and_then(|said| said.get_field_by_name("data").and_then(|class| class.as_enum_number()));
    let kind = pool.get_enum_by_name("midshift.common.v1.DataClass").ok_or("there are no classes")?;
    let secret = kind.get_value_by_name("DATA_CLASS_CREDENTIAL").ok_or("there is no class of credentials")?;
    Ok(class == Some(secret.number()))
}

/// Their `Debug`, which shows all fields but those.
fn without_secrets(messages: &[MessageDescriptor]) -> Result<String, Box<dyn std::error::Error>> {
    let mut text = String::new();
    for message in messages {
        if message.oneofs().any(|oneof| !oneof.is_synthetic()) {
            return Err(format!(
                "{} has a secret and a oneof: give the secret a message of its own",
                message.full_name()
            )
            .into());
        }
        let package = message.package_name().trim_start_matches("midshift.").replace('.', "::");
        let (path, name) = (format!("crate::{package}::{}", message.name()), message.name());
        writeln!(text, "impl ::core::fmt::Debug for {path} {{")?;
        writeln!(text, "fn fmt(&self, f: &mut ::core::fmt::Formatter<'_>) -> ::core::fmt::Result {{")?;
        writeln!(text, "f.debug_struct({name:?})")?;
        for field in message.fields() {
            if !is_secret(message.parent_pool(), &field)? {
                let field = field.name();
                writeln!(text, ".field({field:?}, &self.{field})")?;
            }
        }
        writeln!(text, ".finish_non_exhaustive()\n}}\n}}")?;
    }
    Ok(text)
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
