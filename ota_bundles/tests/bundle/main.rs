//! Bundles as release people make them and as attackers would like them.

mod building;
mod by_hand;
mod directives;
mod encoded_targets;
mod fresh;
mod kept;
mod key_sets;
mod keyring;
mod metadata;
mod releasing;
mod roots;
mod says;
mod sets;
mod shelf;
mod twins;
mod workflow;
