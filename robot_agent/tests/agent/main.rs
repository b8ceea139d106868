//! What a robot does with what it is told, on a bench: no network, no clock, no disk but those of the test.

mod bases;
mod beside;
mod chaos;
mod cuts;
mod device;
mod drives;
mod durability;
mod forward;
mod full;
mod key_sets;
mod lanes;
mod loads;
mod offers;
mod power;
mod release;
mod remote;
mod replays;
mod restarts;
mod rig;
mod session;
mod sets;
mod steps;
mod stop_chaos;
mod stop_cuts;
mod stop_line;
mod stop_software;
mod stops;
mod stops_beside;
#[path = "../../../tests/src/strace.rs"]
mod strace;
mod successor;
mod told_time;
mod trusts;
mod twins;
mod updates;
mod ways;
