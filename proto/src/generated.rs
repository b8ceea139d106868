//! Messages, servers and clients of each package, as they are made of the .proto files.

macro_rules! packages {
    ($($(#[$doc:meta])* $noun:ident $package:literal;)*) => {
        $(
            $(#[$doc])*
            pub mod $noun {
                /// Version 1.
                pub mod v1 {
                    tonic::include_proto!($package);
                }
            }
        )*
    };
}

packages! {
    /// `midshift.common.v1`: words that more than one package needs.
    common "midshift.common.v1";
    /// `midshift.task.v1`: tasks in, results out.
    #[expect(clippy::allow_attributes, clippy::large_enum_variant, reason = "generated code")]
    task "midshift.task.v1";
    /// `midshift.fleet.v1`: robots as the dispatcher sees them, places, areas, and why.
    #[expect(clippy::allow_attributes, reason = "generated code")]
    fleet "midshift.fleet.v1";
    /// `midshift.identity.v1`: who is who, and who did what.
    #[expect(clippy::allow_attributes, reason = "generated code")]
    identity "midshift.identity.v1";
    /// `midshift.link.v1`: the robot's session.
    #[expect(clippy::allow_attributes, clippy::large_enum_variant, reason = "generated code")]
    link "midshift.link.v1";
    /// `midshift.ota.v1`: software of robots.
    #[expect(clippy::allow_attributes, reason = "generated code")]
    ota "midshift.ota.v1";
    /// `midshift.stop.v1`: fleet stop.
    #[expect(clippy::allow_attributes, reason = "generated code")]
    stop "midshift.stop.v1";
    /// `midshift.telemetry.v1`: what robots said.
    #[expect(clippy::allow_attributes, reason = "generated code")]
    telemetry "midshift.telemetry.v1";
    /// `midshift.sim.v1`: the simulator's own face.
    #[expect(clippy::allow_attributes, reason = "generated code")]
    sim "midshift.sim.v1";
}
