//! Compiles the .proto files with protox (no protoc to install) into messages, servers, clients and one descriptor set.

use prost::Message;
use std::path::PathBuf;

const FILES: [&str; 19] = [
    "midshift/common/v1/access.proto",
    "midshift/common/v1/common.proto",
    "midshift/task/v1/task.proto",
    "midshift/task/v1/task_service.proto",
    "midshift/fleet/v1/fleet.proto",
    "midshift/fleet/v1/fleet_service.proto",
    "midshift/identity/v1/audit_service.proto",
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
    std::fs::write(out.join("descriptor_set.bin"), set.encode_to_vec())?;
    let mut config = tonic_prost_build::Config::new();
    config.enable_type_names();
    tonic_prost_build::configure().btree_map(".").compile_fds_with_config(set, config)?;
    Ok(())
}
