//! The person of a `dev` run who looks at robots that stood among people because the stop service was not heard, and resumes them: nobody else is there to look.
//!
//! Invariant: only silences are resumed, each by its name. A fleet stop stays with whoever resets and resumes it. Called by `dev`.

use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::StopId;
use midshift_core::stop::robot::is_silence;
use midshift_proto::task::v1::ResumeHeldRequest;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_store::LiveBoard;
use std::collections::BTreeSet;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;
use tonic::transport::Channel;

/// How often the person looks, real time, as silences are counted.
const ROUND: Duration = Duration::from_secs(5);

/// Silences that stand robots as these say of themselves.
fn silences(board: &LiveBoard<NewestHeartbeat>) -> BTreeSet<StopId> {
    let standing = board.all().into_iter().flat_map(|(_, latest)| latest.report.awaiting_resume.clone());
    standing.filter(is_silence).collect()
}

/// Resumes in each round the robots that stand in silence; ends only by being dropped.
pub async fn resume_silenced(board: Arc<LiveBoard<NewestHeartbeat>>, channel: Channel) -> Infallible {
    let mut client = TaskServiceClient::new(channel);
    loop {
        tokio::time::sleep(ROUND).await;
        for stop_id in silences(&board) {
            let request = ResumeHeldRequest {
                stop_id: stop_id.to_string(),
                reason: "looked: nobody is near".to_owned(),
                ..ResumeHeldRequest::default()
            };
            match client.resume_held(request).await {
                Ok(_) => tracing::info!(%stop_id, "a person looked at a robot that stood in silence, and resumed it"),
                // The next round asks again.
                Err(status) => tracing::debug!(%stop_id, code = status.code() as i32, "a robot could not be resumed"),
            }
        }
    }
}
