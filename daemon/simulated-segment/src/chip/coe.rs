//! The mailbox protocol CANopen over EtherCAT (CoE, ETG.1000.6 section 5.6). The input is a mailbox request, the output is
//! the answer. With a service data object (SDO), the master reads (upload) or writes (download) an object of the device. The
//! master can also request lists of objects.

/// Why an SDO access was refused (ETG.1000.6 table 41).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Abort {
    /// The command specifier is unknown.
    UnknownCommand = 0x0504_0001,
    /// The value does not fit into a mailbox.
    OutOfMemory = 0x0504_0005,
    /// Complete access is not supported.
    UnsupportedAccess = 0x0601_0000,
    /// The object is read-only.
    ReadOnly = 0x0601_0002,
    /// The object does not exist.
    NoObject = 0x0602_0000,
    /// The length of the value differs from the length of the object.
    WrongLength = 0x0607_0010,
    /// The subindex does not exist.
    NoSubindex = 0x0609_0011,
    /// The value is outside the object's range.
    ValueRange = 0x0609_0030,
}

/// Lists of objects that a master can request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ObjectList {
    All,
    /// Objects that can be mapped to outputs.
    RxMappable,
    /// Objects that can be mapped to inputs.
    TxMappable,
    /// Objects whose values must be stored, so that they can be written to a replacement of the device.
    Stored,
    /// Objects that are set at start-up.
    Startup,
}

const LISTS: [ObjectList; 5] = [
    ObjectList::All,
    ObjectList::RxMappable,
    ObjectList::TxMappable,
    ObjectList::Stored,
    ObjectList::Startup,
];

/// The objects of a device.
pub trait ObjectDictionary {
    /// Copies the value of an object into `value`. Returns its length.
    fn upload(&self, index: u16, subindex: u8, value: &mut [u8]) -> Result<usize, Abort>;
    fn download(&mut self, index: u16, subindex: u8, value: &[u8]) -> Result<(), Abort>;
    /// Indices of the objects in a list, ascending.
    fn list(&self, list: ObjectList) -> Vec<u16>;
}

/// Length of the longest supported mailbox \[bytes\].
pub const MAILBOX_MAX: usize = 128;
const MAILBOX_HEADER_LEN: usize = 6;
const COE_HEADER_LEN: usize = 2;

const TYPE_ERROR: u8 = 0;
const TYPE_COE: u8 = 3;
const UNSUPPORTED_PROTOCOL: u16 = 2;
const INVALID_HEADER: u16 = 3;

const SERVICE_EMERGENCY: u8 = 1;
const SERVICE_SDO_REQUEST: u8 = 2;
const SERVICE_SDO_RESPONSE: u8 = 3;
const SERVICE_INFORMATION: u8 = 8;

const COMPLETE_ACCESS: u8 = 0x10;
const EXPEDITED: u8 = 0x02;
const SIZE_INDICATED: u8 = 0x01;
const DOWNLOAD: u8 = 1;
const UPLOAD: u8 = 2;
const DOWNLOADED: u8 = 0x60;
const UPLOADED: u8 = 0x40;
const ABORT: u8 = 0x80;

const LIST_REQUEST: u8 = 1;
const LIST_RESPONSE: u8 = 2;
const INFORMATION_ERROR: u8 = 7;

/// An answer while it is built. The mailbox header is at the beginning of `mailbox`, but is written last.
struct CoeResponse<'a> {
    mailbox: &'a mut [u8; MAILBOX_MAX],
    len: usize,
}

impl CoeResponse<'_> {
    /// Appends bytes; returns false if the mailbox is full.
    fn push(&mut self, bytes: &[u8]) -> bool {
        let end = self.len + bytes.len();
        let Some(target) = self.mailbox.get_mut(self.len..end) else { return false };
        target.copy_from_slice(bytes);
        self.len = end;
        true
    }

    /// Begins a CoE answer after the mailbox header. The mailbox header is written by [`Self::finish`].
    fn begin(&mut self, service: u8) {
        self.len = MAILBOX_HEADER_LEN;
        self.push(&[0, service << 4]);
    }

    /// Writes the mailbox header. The counter in this header is copied from the request. Returns the length of the answer.
    fn finish(self, kind: u8, request: &[u8]) -> usize {
        let length = (self.len - MAILBOX_HEADER_LEN) as u16;
        let counter = request.get(5).copied().unwrap_or(0) & 0x70;
        self.mailbox[..2].copy_from_slice(&length.to_le_bytes());
        self.mailbox[2..5].fill(0);
        self.mailbox[5] = kind | counter;
        self.len
    }
}

/// Answers a mailbox request. Returns the length of the answer, or `None` if the request needs none.
pub fn answer(
    request: &[u8],
    mailbox: &mut [u8; MAILBOX_MAX],
    objects: &mut dyn ObjectDictionary,
) -> Option<usize> {
    let header = request.first_chunk::<MAILBOX_HEADER_LEN>()?;
    let end = MAILBOX_HEADER_LEN + usize::from(u16::from_le_bytes([header[0], header[1]]));
    let mut answer = CoeResponse { mailbox, len: MAILBOX_HEADER_LEN };
    let Some(content) = request.get(MAILBOX_HEADER_LEN..end) else {
        return Some(refuse(answer, INVALID_HEADER, request));
    };
    if header[5] & 0x0f != TYPE_COE {
        return Some(refuse(answer, UNSUPPORTED_PROTOCOL, request));
    }
    let (coe, content) = content.split_first_chunk::<COE_HEADER_LEN>()?;
    match coe[1] >> 4 {
        SERVICE_SDO_REQUEST => sdo(content, &mut answer, objects),
        SERVICE_INFORMATION => information(content, &mut answer, objects),
        _ => return Some(refuse(answer, UNSUPPORTED_PROTOCOL, request)),
    }
    Some(answer.finish(TYPE_COE, request))
}

/// Answers an SDO request with this abort code. `None` if the request is too short for an SDO.
pub fn abort_with(request: &[u8], mailbox: &mut [u8; MAILBOX_MAX], code: u32) -> Option<usize> {
    let sdo = request.get(MAILBOX_HEADER_LEN + COE_HEADER_LEN..)?;
    let &[_, i0, i1, subindex] = sdo.first_chunk::<4>()?;
    let mut answer = CoeResponse { mailbox, len: MAILBOX_HEADER_LEN };
    abort(&mut answer, [i0, i1, subindex], code);
    Some(answer.finish(TYPE_COE, request))
}

/// Writes an emergency message (ETG.1000.6 section 5.6.4) with error code and error register, and without data. A device
/// sends such a message without a request.
pub fn emergency(mailbox: &mut [u8; MAILBOX_MAX], code: u16) -> usize {
    let mut answer = CoeResponse { mailbox, len: MAILBOX_HEADER_LEN };
    answer.begin(SERVICE_EMERGENCY);
    answer.push(&code.to_le_bytes());
    answer.push(&[0x01, 0, 0, 0, 0, 0]);
    answer.finish(TYPE_COE, &[])
}

/// Writes a mailbox error reply (ETG.1000.4 table 30): type 1 and the error code `detail`.
fn refuse(mut answer: CoeResponse<'_>, detail: u16, request: &[u8]) -> usize {
    answer.push(&[1, 0]);
    answer.push(&detail.to_le_bytes());
    answer.finish(TYPE_ERROR, request)
}

fn sdo(content: &[u8], answer: &mut CoeResponse<'_>, objects: &mut dyn ObjectDictionary) {
    let Some((&[command, i0, i1, subindex], data)) = content.split_first_chunk::<4>() else {
        return abort(answer, [0; 3], Abort::UnknownCommand as u32);
    };
    let (index, address) = (u16::from_le_bytes([i0, i1]), [i0, i1, subindex]);
    let outcome = match command >> 5 {
        UPLOAD | DOWNLOAD if command & COMPLETE_ACCESS != 0 => Err(Abort::UnsupportedAccess),
        UPLOAD => upload(index, subindex, answer, objects),
        DOWNLOAD => downloaded(command, data).and_then(|value| {
            objects.download(index, subindex, value)?;
            answer.begin(SERVICE_SDO_RESPONSE);
            answer.push(&[DOWNLOADED, i0, i1, subindex, 0, 0, 0, 0]);
            Ok(())
        }),
        _ => Err(Abort::UnknownCommand),
    };
    if let Err(code) = outcome {
        abort(answer, address, code as u32);
    }
}

fn abort(answer: &mut CoeResponse<'_>, [i0, i1, subindex]: [u8; 3], code: u32) {
    // An abort is always sent with the service "SDO request", by either side.
    answer.begin(SERVICE_SDO_REQUEST);
    answer.push(&[ABORT, i0, i1, subindex]);
    answer.push(&code.to_le_bytes());
}

fn upload(
    index: u16,
    subindex: u8,
    answer: &mut CoeResponse<'_>,
    objects: &dyn ObjectDictionary,
) -> Result<(), Abort> {
    let mut value = [0; MAILBOX_MAX];
    let len = objects.upload(index, subindex, &mut value)?;
    let [i0, i1] = index.to_le_bytes();
    answer.begin(SERVICE_SDO_RESPONSE);
    let fits = if len <= 4 {
        let unused = (4 - len) as u8;
        answer.push(&[UPLOADED | EXPEDITED | SIZE_INDICATED | unused << 2, i0, i1, subindex])
            && answer.push(&value[..4])
    } else {
        answer.push(&[UPLOADED | SIZE_INDICATED, i0, i1, subindex])
            && answer.push(&(len as u32).to_le_bytes())
            && answer.push(&value[..len.min(MAILBOX_MAX)])
    };
    if fits { Ok(()) } else { Err(Abort::OutOfMemory) }
}

/// The value in a download request. A value of up to four bytes is in the header. A longer value follows its length.
fn downloaded(command: u8, data: &[u8]) -> Result<&[u8], Abort> {
    let (inline, rest) = data.split_at_checked(4).ok_or(Abort::WrongLength)?;
    if command & EXPEDITED == 0 {
        let len = u32::from_le_bytes(*inline.first_chunk().ok_or(Abort::WrongLength)?);
        return rest.get(..len as usize).ok_or(Abort::WrongLength);
    }
    let unused = if command & SIZE_INDICATED == 0 { 0 } else { usize::from(command >> 2 & 3) };
    inline.get(..4 - unused).ok_or(Abort::WrongLength)
}

/// Answers a request of the SDO information service. Only lists of objects are supported.
fn information(content: &[u8], answer: &mut CoeResponse<'_>, objects: &dyn ObjectDictionary) {
    let opcode = content.first().map_or(0, |byte| byte & 0x7f);
    let list = content.get(4..).and_then(|rest| rest.first_chunk()).map(|kind| u16::from_le_bytes(*kind));
    answer.begin(SERVICE_INFORMATION);
    match (opcode, list) {
        (LIST_REQUEST, Some(kind)) if usize::from(kind) <= LISTS.len() => {
            answer.push(&[LIST_RESPONSE, 0, 0, 0]);
            answer.push(&kind.to_le_bytes());
            list_objects(kind, answer, objects);
        }
        _ => {
            answer.push(&[INFORMATION_ERROR, 0, 0, 0]);
            answer.push(&(Abort::UnknownCommand as u32).to_le_bytes());
        }
    }
}

/// Appends a list of indices. List 0 contains the lengths of the other five lists.
fn list_objects(kind: u16, answer: &mut CoeResponse<'_>, objects: &dyn ObjectDictionary) {
    match usize::from(kind).checked_sub(1).and_then(|index| LISTS.get(index)) {
        None => {
            for list in LISTS {
                answer.push(&(objects.list(list).len() as u16).to_le_bytes());
            }
        }
        Some(list) => {
            for index in objects.list(*list) {
                answer.push(&index.to_le_bytes());
            }
        }
    }
}
