//! Finds the roll-out that a person names.

use crate::client::{Call, Exit, unary};
use crate::lookup::{self, Found, whole_id};
use crate::pages::Listed;
use midshift_proto::ota::v1;

/// One roll-out.
#[derive(clap::Args)]
pub struct RolloutTarget {
    /// Of which server.
    #[command(flatten)]
    pub call: Call,
    /// Its id, or a prefix that only one roll-out has.
    pub rollout_id: String,
}

impl RolloutTarget {
    /// As it is now.
    pub async fn read(&self) -> Result<v1::Rollout, Exit> {
        let request = v1::GetRolloutRequest { rollout_id: self.rollout_id.clone() };
        let answer = self.call.rollouts().await?.get_rollout(unary(request)).await.map_err(Exit::with_facts)?;
        Ok(answer.into_inner().rollout.unwrap_or_default())
    }
}

/// The whole id of a roll-out.
pub async fn find(call: &Call, typed: &str) -> Result<String, Exit> {
    let mut client = call.rollouts().await?;
    let listed = async {
        let (page_size, rollout_id_prefix) = (lookup::SHOWN, typed.to_owned());
        let request = v1::ListRolloutsRequest { page_size, rollout_id_prefix, page_token: String::new() };
        let page = client.list_rollouts(unary(request)).await?.into_inner();
        Ok(Found::page(&page, Listed::row))
    };
    whole_id("rollout", typed, listed).await
}
