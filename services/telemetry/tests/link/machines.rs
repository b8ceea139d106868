//! What a robot says it has installed, and the key of the machine that says it.

use crate::world::{Result, Robot, World, hello, world};
use midshift_bundle::installed::seal;
use midshift_bundle::keys::SecretKey;
use midshift_core::ids::{RobotId, SetId};
use midshift_core::session::Session;
use midshift_core::update::Installed;
use midshift_proto::session::Previous;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{self, GetRobotRequest};
use midshift_store::load;

pub fn key(seed: u8) -> SecretKey {
    SecretKey::of_seed([seed; 32])
}

pub fn installed() -> Result<Installed> {
    let factory = SetId::parse("factory")?;
    Ok(Installed {
        robot_id: RobotId::parse("r1")?,
        boot_id: "boot".into(),
        device_key: String::new(),
        model: "bench-1".into(),
        free_bytes: 1_000,
        running: factory.clone(),
        current: factory,
        previous: None,
        sets: Vec::new(),
    })
}

/// One Hello that says `envelope`; its proof for the next, its row, and what people see.
async fn says(world: &World, previous: Option<Previous>, envelope: String) -> Result<(Previous, Session, v1::Robot)> {
    let hello = midshift_proto::session::Hello { installed: envelope, ..hello(previous)? };
    let robot = Robot::attach_saying(world, hello).await?;
    let (row, _) = load::<Session>(world.store.as_ref(), "r1").await?.ok_or("no row")?;
    assert_eq!(row.session_epoch, robot.welcome.session_epoch, "the session goes on whatever it says");
    let mut client = TelemetryServiceClient::new(world.channel.clone());
    let shown = loop {
        let asked = client.get_robot(GetRobotRequest { robot_id: "r1".to_owned() }).await;
        let shown = asked.ok().and_then(|answer| answer.into_inner().robot);
        match shown.filter(|shown| shown.session_epoch == row.session_epoch) {
            Some(shown) => break shown,
            None => tokio::task::yield_now().await,
        }
    };
    Ok((robot.proof(), row, shown))
}

#[tokio::test(start_paused = true)]
async fn the_first_key_of_a_robot_is_remembered_and_what_it_signs_is_shown() -> Result<()> {
    let world = world().await?;
    let (proof, row, shown) = says(&world, None, seal(installed()?, &key(1))).await?;
    let public = key(1).public().hex();
    assert_eq!((row.device_key.as_deref(), row.device_key_changed), (Some(public.as_str()), false));
    assert_eq!(row.installed, Some(Installed { device_key: public.clone(), ..installed()? }));
    let told = shown.installed.ok_or("is shown")?;
    assert_eq!((told.running.as_str(), told.free_bytes, told.model.as_str()), ("factory", 1_000, "bench-1"));
    assert_eq!((shown.device_key.as_str(), shown.device_key_changed), (public.as_str(), false));
    // A session that says nothing of it forgets no key.
    let (_, row, _) = says(&world, Some(proof), String::new()).await?;
    assert_eq!((row.installed, row.device_key, row.device_key_changed), (None, Some(public), false));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn what_another_key_signs_is_not_believed_and_people_see_it() -> Result<()> {
    let world = world().await?;
    let (proof, ..) = says(&world, None, seal(installed()?, &key(1))).await?;
    let (proof, row, shown) = says(&world, Some(proof), seal(installed()?, &key(2))).await?;
    let public = key(1).public().hex();
    assert_eq!((row.installed, row.device_key, row.device_key_changed), (None, Some(public.clone()), true));
    assert_eq!((shown.device_key, shown.device_key_changed, shown.installed), (public, true, None));
    let (_, row, shown) = says(&world, Some(proof), seal(installed()?, &key(1))).await?;
    assert!(row.installed.is_some() && !row.device_key_changed && !shown.device_key_changed, "the right one again");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn what_no_key_signed_for_this_start_is_not_believed_and_teaches_no_key() -> Result<()> {
    let world = world().await?;
    let other_start = seal(Installed { boot_id: "another".into(), ..installed()? }, &key(1));
    let mut proof = None;
    for envelope in [other_start, "{}".to_owned(), "no envelope".to_owned()] {
        let (next, row, _) = says(&world, proof, envelope).await?;
        assert_eq!((row.installed, row.device_key, row.device_key_changed), (None, None, false));
        proof = Some(next);
    }
    Ok(())
}
