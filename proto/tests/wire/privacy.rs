//! What each message says of itself (`common/v1/privacy.proto`): every one says it, none can carry what nobody may keep, and what proves who somebody is
//! is never shown. Each rule is a function of descriptors, tried on some that break it.

use midshift_core::limits;
use midshift_core::privacy::{DataClass, Place, Purpose, RETENTION_RULES, Retention};
use midshift_proto::FILE_DESCRIPTOR_SET;
use prost_reflect::{DescriptorPool, DynamicMessage, FieldDescriptor, Kind, MessageDescriptor, ReflectMessage};
use std::collections::{BTreeMap, BTreeSet};

/// What one message or field says.
type Said = (DataClass, Purpose, Retention);

/// Fields of type `bytes`, each with the bytes of it that are taken or sent at most, and where that is enforced.
const BYTES: &[(&str, usize, &str)] = &[
    ("midshift.ota.v1.FetchChunksResponse.data", limits::CHUNK_BYTES, "services/ota/src/downloads.rs"),
    ("midshift.ota.v1.GetMetadataResponse.document", limits::SIGNED_DOCUMENT_BYTES, "ota_bundles/src/trust.rs"),
    ("midshift.ota.v1.PublishRepositoryRequest.roots", limits::SIGNED_DOCUMENT_BYTES, "ota_bundles/src/trust.rs"),
    ("midshift.ota.v1.PublishRepositoryRequest.targets", limits::SIGNED_DOCUMENT_BYTES, "ota_bundles/src/trust.rs"),
    ("midshift.ota.v1.UploadTargetRequest.data", limits::UPLOAD_PIECE_BYTES, "services/ota/src/grpc.rs"),
    ("midshift.stop.v1.Reset.proof", limits::STOP_PROOF_BYTES, "proto/src/convert/stop.rs"),
    ("midshift.stop.v1.Stop.proof", limits::STOP_PROOF_BYTES, "proto/src/convert/stop.rs"),
    ("midshift.stop.v1.Synced.key", limits::STOP_KEY_BYTES, "proto/src/convert/stop.rs"),
];

/// Fields that could be filled with anything: lists of numbers or of points, and parameters of no fixed form. Each with its limit and where that is enforced.
const SHAPELESS: &[(&str, usize, &str)] = &[
    ("midshift.fleet.v1.MaintenanceWindow.days", 7, "core/src/policy.rs"),
    ("midshift.link.v1.Assignment.route", limits::ROUTE_POINTS_MAX, "core/src/fleet"),
    ("midshift.link.v1.Hello.protocol_versions", limits::CONTROL_MESSAGE_BYTES, "services/telemetry/src/link.rs"),
    ("midshift.link.v1.WorkAction.params", limits::PARAMS_BYTES_MAX, "core/src/task"),
    ("midshift.ota.v1.PlanRolloutResponse.wave_sizes", limits::CONTROL_MESSAGE_BYTES, "core/src/rollout"),
    ("midshift.stop.v1.Stop.boxes", limits::REGION_BOXES_MAX, "proto/src/convert/stop.rs"),
    ("midshift.task.v1.Action.params", limits::PARAMS_BYTES_MAX, "core/src/task"),
    ("midshift.task.v1.TaskTypeField.default", limits::TYPE_TEXT_BYTES_MAX as usize, "core/src/task/types"),
    ("midshift.task.v1.TypedTask.fields", limits::TASK_MESSAGE_BYTES, "core/src/task/types"),
    ("midshift.task.v1.UpdateTaskRequest.update_mask", limits::CONTROL_MESSAGE_BYTES, "proto/src/convert/task.rs"),
];

/// Words in names of messages and fields that nobody may bring in.
const MEDIA: &[&str] = &[
    "audio",
    "bitmap",
    "camera",
    "cloud",
    "depth",
    "face",
    "faces",
    "fingerprint",
    "image",
    "images",
    "jpeg",
    "lidar",
    "microphone",
    "photo",
    "picture",
    "pixel",
    "pixels",
    "png",
    "pointcloud",
    "recording",
    "scan",
    "scans",
    "snapshot",
    "sound",
    "speech",
    "thumbnail",
    "video",
    "voice",
    "voxel",
    "voxels",
];

/// What tells of people in another way than as a zone and a bucket.
const PEOPLE: &[&str] =
    &["people", "human", "humans", "pedestrian", "pedestrians", "bystander", "bystanders", "worker", "badge"];

/// Fields that name a person or program by what they are called.
const WHO: &[&str] = &["actor", "requester", "created_by", "revoked_by", "approved_by"];
/// Fields that prove who somebody is by what they are called.
const SECRETS: &[&str] = &["secret", "session_secret", "password", "private_key", "bearer"];
/// A bool's name may have these words: it says how full a snapshot is.
const WORDS_KEPT: &[&str] = &["midshift.telemetry.v1.WatchRobotsResponse.snapshot_complete"];

fn ours(pool: &DescriptorPool) -> Vec<MessageDescriptor> {
    let entries = |message: &MessageDescriptor| !message.is_map_entry();
    pool.all_messages().filter(|m| m.package_name().starts_with("midshift.")).filter(entries).collect()
}

/// A word of core by its number on the wire, by way of its name: `DATA_CLASS_PEOPLE_NEAR` is `people_near`.
fn word<T: Copy>(
    said: &DynamicMessage,
    field: &str,
    prefix: &str,
    all: &[T],
    name: fn(T) -> &'static str,
) -> Option<T> {
    let number = said.get_field_by_name(field)?.as_enum_number()?;
    let field = said.descriptor().get_field_by_name(field)?;
    let Kind::Enum(words) = field.kind() else { return None };
    let word = words.get_value(number)?.name().trim_start_matches(prefix).to_lowercase();
    all.iter().copied().find(|one| name(*one) == word)
}

fn read(options: &DynamicMessage, pool: &DescriptorPool, name: &str) -> Option<Option<Said>> {
    let option = pool.get_extension_by_name(&format!("midshift.common.v1.{name}")).expect("the option");
    options.has_extension(&option).then(|| {
        let said = options.get_extension(&option);
        let said = said.as_message()?;
        Some((
            word(said, "data", "DATA_CLASS_", DataClass::ALL, DataClass::as_str)?,
            word(said, "purpose", "PURPOSE_", Purpose::ALL, Purpose::as_str)?,
            word(said, "retention", "RETENTION_", Retention::ALL, Retention::as_str)?,
        ))
    })
}

fn of_message(message: &MessageDescriptor) -> Option<Said> {
    read(&message.options(), message.parent_pool(), "privacy").flatten()
}

/// What a field is by its own option, or by its message; none: by the message that it holds.
fn of_field(field: &FieldDescriptor) -> Option<Said> {
    let own = read(&field.options(), field.parent_message().parent_pool(), "field_privacy").flatten();
    let holds_ours = || matches!(field.kind(), Kind::Message(kind) if kind.package_name().starts_with("midshift.") && !kind.is_map_entry());
    own.or_else(|| if holds_ours() { None } else { of_message(field.parent_message()) })
}

/// Messages that do not say whole what they hold, and fields that say it wrongly or for nothing.
fn unsaid(messages: &[MessageDescriptor]) -> Vec<String> {
    let mut bad = Vec::new();
    for message in messages {
        let said = of_message(message);
        if said.is_none() {
            bad.push(format!("{} does not say what it holds", message.full_name()));
        }
        for field in message.fields() {
            match read(&field.options(), message.parent_pool(), "field_privacy") {
                None => {}
                Some(None) => bad.push(format!("{} does not say whole what it is", field.full_name())),
                Some(own) if own == said => bad.push(format!("{} says the same as its message", field.full_name())),
                Some(_) => {}
            }
        }
    }
    bad
}

fn words(name: &str) -> Vec<String> {
    let mut spaced = String::new();
    for c in name.chars() {
        if c.is_ascii_uppercase() {
            spaced.push('_');
        }
        spaced.push(c.to_ascii_lowercase());
    }
    spaced.split('_').filter(|word| !word.is_empty()).map(str::to_owned).collect()
}

/// Whether somebody could send a cloud of points in it: a list of numbers, of messages with coordinates, or of no fixed form.
fn is_shapeless(field: &FieldDescriptor) -> bool {
    let coordinates = |message: &MessageDescriptor| {
        message.name() == "Pose"
            || message
                .fields()
                .any(|f| words(f.name()).first().is_some_and(|w| ["x", "y", "z", "x0", "y0"].contains(&w.as_str())))
    };
    match field.kind() {
        Kind::Message(kind) if kind.is_map_entry() => false,
        Kind::Message(kind) if kind.full_name().starts_with("google.protobuf.") => {
            !["google.protobuf.Timestamp", "google.protobuf.Duration"].contains(&kind.full_name())
        }
        Kind::Message(kind) => field.is_list() && coordinates(&kind),
        Kind::String | Kind::Bool | Kind::Enum(_) | Kind::Bytes => false,
        _ => field.is_list(),
    }
}

/// Fields that could carry images, sound or clouds of points.
fn carriers(messages: &[MessageDescriptor]) -> Vec<String> {
    let named = |name: &str| words(name).iter().any(|word| MEDIA.contains(&word.as_str()));
    let on = |list: &[(&str, usize, &str)], field: &FieldDescriptor| {
        list.iter().any(|(name, ..)| *name == field.full_name())
    };
    let mut bad: Vec<String> = messages.iter().filter(|m| named(m.name())).map(|m| m.full_name().to_owned()).collect();
    for field in messages.iter().flat_map(MessageDescriptor::fields) {
        let is_named = named(field.name()) && !WORDS_KEPT.contains(&field.full_name());
        let is_bytes = matches!(field.kind(), Kind::Bytes) && !on(BYTES, &field);
        if is_named || is_bytes || is_shapeless(&field) && !on(SHAPELESS, &field) {
            bad.push(field.full_name().to_owned());
        }
    }
    bad
}

/// Fields about people near a robot that say more than that some are there, in which zone, in which bucket of distance.
fn identities(messages: &[MessageDescriptor]) -> Vec<String> {
    let mut bad = Vec::new();
    for field in messages.iter().flat_map(MessageDescriptor::fields) {
        let is_near = of_field(&field).is_some_and(|(class, ..)| class == DataClass::PeopleNear);
        let of_people = words(field.name()).iter().any(|word| PEOPLE.contains(&word.as_str()));
        let is_allowed = match field.kind() {
            Kind::Bool | Kind::Enum(_) => !field.is_list(),
            Kind::String => ["zone", "area_id"].contains(&field.name()) && !field.is_list(),
            _ => false,
        };
        if is_near && !is_allowed || of_people && !is_near {
            bad.push(field.full_name().to_owned());
        }
    }
    bad
}

/// Fields whose name says that they are of another class than they say.
fn misnamed(messages: &[MessageDescriptor]) -> Vec<String> {
    let mut bad = Vec::new();
    for field in messages.iter().flat_map(MessageDescriptor::fields) {
        let is_text = matches!(field.kind(), Kind::String | Kind::Bytes);
        let wanted = match field.name() {
            name if is_text && (WHO.contains(&name) || name == "reason") => DataClass::Person,
            name if is_text && SECRETS.contains(&name) => DataClass::Credential,
            "waypoint" if field.parent_message().name() == "Vitals" => DataClass::Position,
            _ => continue,
        };
        if of_field(&field).is_some_and(|(class, ..)| class != wanted) {
            bad.push(format!("{} is not of class {}", field.full_name(), wanted.as_str()));
        }
    }
    bad
}

/// Kinds of data that the wire says are kept, and the list of places does not.
fn homeless(messages: &[MessageDescriptor]) -> Vec<String> {
    let is_kept = |class, retention| {
        RETENTION_RULES.iter().any(|rule| rule.holds.contains(&class) && rule.retention == retention)
    };
    let fields = messages.iter().flat_map(MessageDescriptor::fields);
    let said = messages.iter().filter_map(of_message).chain(fields.filter_map(|field| of_field(&field)));
    let said: BTreeSet<Said> = said
        .filter(|(class, _, retention)| {
            *class != DataClass::PeopleNear && *class != DataClass::None && *retention != Retention::Transit
        })
        .collect();
    let homeless = said.into_iter().filter(|(class, _, retention)| !is_kept(*class, *retention));
    homeless.map(|(class, _, retention)| format!("{} kept {}", class.as_str(), retention.as_str())).collect()
}

fn pool() -> DescriptorPool {
    DescriptorPool::decode(FILE_DESCRIPTOR_SET).expect("descriptors")
}

/// The messages of a file that somebody might write.
fn made_up(body: &str) -> Vec<MessageDescriptor> {
    let dir = std::env::temp_dir().join(format!("midshift-made-up-{}-{:p}", std::process::id(), body));
    std::fs::create_dir_all(&dir).expect("a folder");
    let head = "syntax = \"proto3\"; package midshift.made.v1; import \"midshift/common/v1/common.proto\"; \
                import \"midshift/common/v1/privacy.proto\"; import \"google/protobuf/any.proto\";\n";
    std::fs::write(dir.join("made.proto"), format!("{head}{body}")).expect("written");
    let mut compiler =
        protox::Compiler::new([dir.as_path(), std::path::Path::new(env!("CARGO_MANIFEST_DIR"))]).expect("a compiler");
    compiler.include_imports(true).open_file("made.proto").expect("it compiles");
    let pool = DescriptorPool::decode(compiler.encode_file_descriptor_set().as_slice()).expect("descriptors");
    std::fs::remove_dir_all(&dir).expect("gone");
    pool.all_messages().filter(|m| m.package_name() == "midshift.made.v1").collect()
}

const MACHINE: &str = "option (midshift.common.v1.privacy) = {data: DATA_CLASS_MACHINE, purpose: PURPOSE_DIAGNOSE, retention: RETENTION_WEEK};";
const NEAR: &str = "[(midshift.common.v1.field_privacy) = {data: DATA_CLASS_PEOPLE_NEAR, purpose: PURPOSE_OPERATE, retention: RETENTION_NEWEST}]";

#[test]
fn every_message_says_what_it_holds_what_for_and_how_long() {
    let pool = pool();
    let messages = ours(&pool);
    assert!(messages.len() > 300, "only {} were looked at", messages.len());
    assert_eq!(unsaid(&messages), Vec::<String>::new());
}

#[test]
fn a_message_that_says_nothing_or_half_of_it_is_found() {
    assert_eq!(unsaid(&made_up("message M { string id = 1; }")), ["midshift.made.v1.M does not say what it holds"]);
    let half = "message M { option (midshift.common.v1.privacy) = {data: DATA_CLASS_MACHINE, purpose: PURPOSE_CALL}; }";
    assert_eq!(unsaid(&made_up(half)), ["midshift.made.v1.M does not say what it holds"]);
    let half = "string id = 1 [(midshift.common.v1.field_privacy) = {data: DATA_CLASS_PERSON}];";
    let found = unsaid(&made_up(&format!("message M {{ {MACHINE} {half} }}")));
    assert_eq!(found, ["midshift.made.v1.M.id does not say whole what it is"]);
    let same =
        MACHINE.replace("option (midshift.common.v1.privacy)", "string id = 1 [(midshift.common.v1.field_privacy)");
    let same = same.replace("};", "}];");
    let found = unsaid(&made_up(&format!("message M {{ {MACHINE} {same} }}")));
    assert_eq!(found, ["midshift.made.v1.M.id says the same as its message"]);
    assert_eq!(unsaid(&made_up(&format!("message M {{ {MACHINE} string id = 1; }}"))), Vec::<String>::new());
}

#[test]
fn nothing_can_carry_images_sound_or_clouds_of_points() {
    let pool = pool();
    assert_eq!(carriers(&ours(&pool)), Vec::<String>::new());
}

#[test]
fn fields_that_could_carry_them_are_found_however_they_are_called() {
    let found = |fields: &str| -> Vec<String> {
        let found = carriers(&made_up(&format!("message M {{ {MACHINE} {fields} }}")));
        found.iter().map(|name| name.trim_start_matches("midshift.made.v1.").to_owned()).collect()
    };
    assert_eq!(found("bytes blob = 1; string name = 2; repeated string names = 3;"), ["M.blob"]);
    assert_eq!(found("string camera_url = 1; string last_image = 2;"), ["M.camera_url", "M.last_image"]);
    assert_eq!(found("repeated float values = 1; repeated sint32 more = 2; float one = 3;"), ["M.values", "M.more"]);
    assert_eq!(found("repeated midshift.common.v1.Pose seen = 1; midshift.common.v1.Pose here = 2;"), ["M.seen"]);
    assert_eq!(found("google.protobuf.Any extra = 1;"), ["M.extra"]);
    assert_eq!(found("map<string, bytes> extra = 1; map<string, string> labels = 2;").len(), 1);
    let point = format!("message Dot {{ {MACHINE} float x = 1; }} message N {{ {MACHINE} repeated Dot dots = 1; }}");
    assert_eq!(carriers(&made_up(&point)), ["midshift.made.v1.N.dots"]);
    let named = carriers(&made_up(&format!("message CameraFrame {{ {MACHINE} }}")));
    assert_eq!(named, ["midshift.made.v1.CameraFrame"]);
}

#[test]
fn lists_of_what_may_carry_bytes_name_fields_that_are_there_and_limits_that_are_enforced_there() {
    let pool = pool();
    let messages = ours(&pool);
    let fields: BTreeMap<String, FieldDescriptor> =
        messages.iter().flat_map(MessageDescriptor::fields).map(|f| (f.full_name().to_owned(), f)).collect();
    for (name, cap, place) in BYTES {
        let field = fields.get(*name).unwrap_or_else(|| panic!("{name} is not there"));
        assert!(matches!(field.kind(), Kind::Bytes) && *cap > 0, "{name}");
        let constants: &[&str] = match *cap {
            limits::CHUNK_BYTES => &["limits::CHUNK_BYTES"],
            limits::SIGNED_DOCUMENT_BYTES => &["limits::SIGNED_DOCUMENT_BYTES"],
            limits::UPLOAD_PIECE_BYTES => &["limits::UPLOAD_PIECE_BYTES"],
            limits::STOP_PROOF_BYTES => &["limits::STOP_PROOF_BYTES"],
            limits::STOP_KEY_BYTES => &["limits::STOP_KEY_BYTES"],
            _ => panic!("{name}: a limit that nothing enforces"),
        };
        let path = format!("{}/../{place}", env!("CARGO_MANIFEST_DIR"));
        let text = std::fs::read_to_string(&path).expect(&path);
        assert!(constants.iter().any(|constant| text.contains(constant)), "{name}: {place} does not enforce it");
    }
    for (name, cap, place) in SHAPELESS {
        let field = fields.get(*name).unwrap_or_else(|| panic!("{name} is not there"));
        assert!(is_shapeless(field) && *cap > 0, "{name}");
        assert!(std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(place).exists(), "{name}: {place}");
    }
}

#[test]
fn of_people_near_a_robot_the_wire_says_that_they_are_there_and_never_who() {
    let pool = pool();
    assert_eq!(identities(&ours(&pool)), Vec::<String>::new());
}

#[test]
fn a_field_that_would_tell_who_is_near_a_robot_is_found() {
    let found = |fields: &str| identities(&made_up(&format!("message M {{ {MACHINE} {fields} }}")));
    assert_eq!(found(&format!("string badge_id = 1 {NEAR};")), ["midshift.made.v1.M.badge_id"]);
    assert_eq!(
        found("uint32 people_count = 1;"),
        ["midshift.made.v1.M.people_count"],
        "it says that it is of machines"
    );
    assert_eq!(found(&format!("uint32 distance_mm = 1 {NEAR};")), ["midshift.made.v1.M.distance_mm"], "no bucket");
    assert_eq!(found(&format!("repeated string zone = 1 {NEAR};")), ["midshift.made.v1.M.zone"]);
    let near = format!(
        "enum Bucket {{ BUCKET_UNSPECIFIED = 0; }} message N {{ {MACHINE} string zone = 1 {NEAR}; Bucket bucket = 2 {NEAR}; }}"
    );
    assert_eq!(identities(&made_up(&near)), Vec::<String>::new());
}

#[test]
fn what_names_a_person_or_proves_who_somebody_is_says_so() {
    let pool = pool();
    assert_eq!(misnamed(&ours(&pool)), Vec::<String>::new());
    let found =
        misnamed(&made_up(&format!("message M {{ {MACHINE} string actor = 1; string secret = 2; bool reason = 3; }}")));
    assert_eq!(
        found,
        ["midshift.made.v1.M.actor is not of class person", "midshift.made.v1.M.secret is not of class credential"]
    );
}

#[test]
fn what_messages_say_is_kept_has_a_place_in_the_list() {
    let pool = pool();
    assert_eq!(homeless(&ours(&pool)), Vec::<String>::new());
    let body = "message M { option (midshift.common.v1.privacy) = {data: DATA_CLASS_POSITION, purpose: PURPOSE_ACCOUNT, retention: RETENTION_YEAR}; }";
    assert_eq!(homeless(&made_up(body)), ["position kept year"], "nobody said where positions stay for a year");
    assert!(RETENTION_RULES.iter().any(|rule| rule.place == Place::Samples));
}

#[test]
fn the_words_of_core_and_of_the_wire_are_the_same() {
    let pool = pool();
    let wire = |name: &str, prefix: &str| -> Vec<String> {
        let words = pool.get_enum_by_name(&format!("midshift.common.v1.{name}")).expect("an enum");
        words.values().skip(1).map(|v| v.name().trim_start_matches(prefix).to_lowercase()).collect()
    };
    let names = |all: Vec<&str>| all.into_iter().map(str::to_owned).collect::<Vec<_>>();
    assert_eq!(wire("DataClass", "DATA_CLASS_"), names(DataClass::ALL.iter().map(|one| one.as_str()).collect()));
    assert_eq!(wire("Purpose", "PURPOSE_"), names(Purpose::ALL.iter().map(|one| one.as_str()).collect()));
    assert_eq!(wire("Retention", "RETENTION_"), names(Retention::ALL.iter().map(|one| one.as_str()).collect()));
}

/// Values of every message with a secret, which is `planted` in each.
fn with_secrets(planted: &str) -> Vec<(&'static str, String)> {
    use midshift_proto::{identity::v1 as identity, link::v1 as link, stop::v1 as stop};
    let text = || planted.to_owned();
    let previous = link::PreviousSession { session_epoch: 7, secret: text() };
    vec![
        (
            "midshift.identity.v1.EnrolRequest",
            format!("{:?}", identity::EnrolRequest { secret: text(), ..Default::default() }),
        ),
        (
            "midshift.identity.v1.CreateTokenResponse",
            format!("{:?}", identity::CreateTokenResponse { secret: text(), ..Default::default() }),
        ),
        (
            "midshift.identity.v1.RotateTokenResponse",
            format!("{:?}", identity::RotateTokenResponse { secret: text(), ..Default::default() }),
        ),
        (
            "midshift.identity.v1.CreateEnrolmentResponse",
            format!("{:?}", identity::CreateEnrolmentResponse { secret: text(), ..Default::default() }),
        ),
        (
            "midshift.link.v1.PreviousSession",
            format!("{:#?}", link::Hello { previous: Some(previous), ..Default::default() }),
        ),
        ("midshift.link.v1.Welcome", format!("{:?}", link::Welcome { session_secret: text(), ..Default::default() })),
        (
            "midshift.link.v1.ReplayStatusRequest",
            format!("{:?}", link::ReplayStatusRequest { session_secret: text(), ..Default::default() }),
        ),
        (
            "midshift.stop.v1.Reset",
            format!("{:?} {planted:?}", stop::Reset { proof: planted.as_bytes().to_vec(), ..Default::default() }),
        ),
        (
            "midshift.stop.v1.Stop",
            format!("{:?} {planted:?}", stop::Stop { proof: planted.as_bytes().to_vec(), ..Default::default() }),
        ),
    ]
}

#[test]
fn a_secret_is_never_shown_by_debug() {
    let pool = pool();
    let fields = ours(&pool).into_iter().flat_map(|m| m.fields().collect::<Vec<_>>());
    let secret = |field: &FieldDescriptor| of_field(field).is_some_and(|(class, ..)| class == DataClass::Credential);
    let messages: BTreeSet<String> =
        fields.filter(secret).map(|field| field.parent_message().full_name().to_owned()).collect();
    let shown = with_secrets("canary");
    let looked_at: BTreeSet<String> = shown.iter().map(|(name, _)| (*name).to_owned()).collect();
    assert_eq!(messages, looked_at, "plant a secret in each message that can hold one");
    for (name, text) in shown {
        match name {
            "midshift.stop.v1.Stop" | "midshift.stop.v1.Reset" => {
                assert!(!text.contains("99, 97, 110") && text.contains("stop_id"), "{text}")
            }
            _ => assert!(!text.contains("canary") && text.contains(".."), "{name}: {text}"),
        }
    }
}

/// The tables of docs/privacy.md, by the name of their mark.
fn tables(messages: &[MessageDescriptor]) -> Vec<(&'static str, String)> {
    let classes = DataClass::ALL.iter().map(|class| format!("| `{}` | {} |", class.as_str(), class.says()));
    let mut all = vec![("classes", table("| class | what it is |\n|---|---|", classes.collect()))];
    let places = RETENTION_RULES.iter().map(|rule| {
        let kind = match rule.place {
            Place::Table(_) => "table",
            Place::Log(_) => "log",
            Place::Samples | Place::CoarseSamples => "samples",
            Place::Gaps | Place::Heard => "beside rows",
            Place::File(_) => "file",
            Place::Robot(_) => "on the robot",
        };
        let holds: Vec<&str> = rule.holds.iter().map(|class| class.as_str()).collect();
        let long = match rule.place {
            Place::Samples => "24 hours, then coarser.",
            _ if rule.retention == Retention::Coarsened => "30 days.",
            _ => rule.retention.says(),
        };
        format!("| `{}` | {kind} | {} | {} | {long} |", rule.place.as_str(), holds.join(", "), rule.purpose.as_str())
    });
    all.push(("places", table("| place | is | holds | for | how long |\n|---|---|---|---|---|", places.collect())));
    let mut said: BTreeMap<Said, Vec<String>> = BTreeMap::new();
    for message in messages {
        let short = |name: &str| name.trim_start_matches("midshift.").to_owned();
        let own = message.fields().filter_map(|field| {
            let own = read(&field.options(), message.parent_pool(), "field_privacy").flatten()?;
            Some((own, short(field.full_name())))
        });
        for (said_of, name) in of_message(message).map(|said| (said, short(message.full_name()))).into_iter().chain(own)
        {
            said.entry(said_of).or_default().push(format!("`{name}`"));
        }
    }
    let lines = said.into_iter().filter(|((_, _, retention), _)| *retention != Retention::Transit);
    let lines = lines.map(|((class, purpose, retention), names)| {
        format!("| {} | {} | {} | {} |", class.as_str(), purpose.as_str(), retention.as_str(), names.join(" "))
    });
    all.push((
        "messages",
        table("| class | for | how long | messages and fields |\n|---|---|---|---|", lines.collect()),
    ));
    all
}

fn table(head: &str, lines: Vec<String>) -> String {
    format!("{head}\n{}\n", lines.join("\n"))
}

#[test]
fn golden_tables_of_the_page_of_privacy_are_as_messages_and_the_list_say() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/privacy.md");
    let page = std::fs::read_to_string(path).expect("the page");
    let pool = pool();
    let mut wanted = page.clone();
    for (mark, table) in tables(&ours(&pool)) {
        let mark = format!("<!-- {mark} -->\n");
        let (before, rest) = wanted.split_once(&mark).unwrap_or_else(|| panic!("the page has no {mark}"));
        let (_, after) = rest.split_once("<!-- end -->").expect("an end");
        wanted = format!("{before}{mark}{table}<!-- end -->{after}");
    }
    if std::env::var_os("BLESS").is_some() {
        std::fs::write(path, &wanted).expect("written");
        return;
    }
    assert!(
        page == wanted,
        "docs/privacy.md is not as messages and core::privacy say: run with BLESS=1 and look at what changed"
    );
}
