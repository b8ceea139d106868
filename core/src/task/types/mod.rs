//! Task types that a site knows: each has fields with units and bounds, and steps that are made of them.
//!
//! `field` is what one value may be, `definition` a type and its row, `template` makes the steps of a task, `catalogue` is
//! all types of a site, `commands` what people change of them. A type binds a task at its admission alone: the steps that
//! were made stay as they are.

pub mod catalogue;
pub mod commands;
pub mod definition;
pub mod field;
pub mod template;

pub use catalogue::TypeCatalogue;
pub use commands::TypeCommand;
pub use definition::{StepTemplate, TaskType, TaskTypeRow, TemplateKind};
pub use field::{FieldKind, TypeField};
pub use template::TypedTask;
