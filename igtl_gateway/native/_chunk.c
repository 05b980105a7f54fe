/* The compiled part of igtl_gateway/record/sessionfile/chunk_rows.py, which documents the functions.
 *
 * index_messages also exists in Python, with an equal result.  add_rows exists only here; what it leaves goes through
 * SessionWriter.write, which makes the same bytes of it.  Rows are records of the recorder's queue: _queue.h has their
 * layout.  Numbers in MCAP and CDR are little-endian here, so the module is not built for other machines.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdint.h>
#include <string.h>

#include "kernel/_queue.h"
#include "kernel/_records.h"

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "this part writes numbers as they are in memory"
#endif

#define MESSAGE_INDEX 7 /* opcode */
/* Of a message index: channel, and bytes of its pairs. */
#define INDEX_HEAD 6
#define PAIR 16

#define TICKS_AT 34 /* in an OpenIGTLink header, as BODY_SIZE_AT */
#define BODY_SIZE_AT 42

#define NS_PER_S 1000000000ULL
#define STAMP_END (0x80000000ULL * NS_PER_S) /* from here on the seconds of a ROS stamp do not fit */

static uint8_t *put(uint8_t *at, const void *value, size_t size)
{
    memcpy(at, value, size);
    return at + size;
}

static uint8_t *put_u8(uint8_t *at, uint8_t value)
{
    *at = value;
    return at + 1;
}

static uint8_t *put_u16(uint8_t *at, uint16_t value)
{
    return put(at, &value, 2);
}

static uint8_t *put_u32(uint8_t *at, uint32_t value)
{
    return put(at, &value, 4);
}

static uint8_t *put_u64(uint8_t *at, uint64_t value)
{
    return put(at, &value, 8);
}

/* -- rows into a chunk -------------------------------------------------------------------------------------------- */

/* How the entries of a stream become messages: an item of the list ``streams``. */
struct stream {
    uint16_t channel;
    int direction; /* 0 from, 1 to a peer; -1: the payload is the message */
    const uint8_t *same;
    Py_ssize_t same_size;
};

static int get_stream(PyObject *item, struct stream *stream)
{
    if (!PyTuple_CheckExact(item) || PyTuple_GET_SIZE(item) != 3 || !PyBytes_CheckExact(PyTuple_GET_ITEM(item, 2)))
        return 0;
    long channel = PyLong_AsLong(PyTuple_GET_ITEM(item, 0)), direction = PyLong_AsLong(PyTuple_GET_ITEM(item, 1));
    stream->channel = (uint16_t)channel;
    stream->direction = (int)direction;
    stream->same = (const uint8_t *)PyBytes_AS_STRING(PyTuple_GET_ITEM(item, 2));
    stream->same_size = PyBytes_GET_SIZE(PyTuple_GET_ITEM(item, 2));
    return 1;
}

static uint8_t *put_raw_head(uint8_t *at, const struct stream *stream, const uint64_t *row, const uint8_t *payload)
{
    const uint64_t size = row[1], stamp_ns = row[3], source_ns = row[4];
    const uint8_t encapsulation[4] = {0, 1, 0, 0}, padding[3] = {0, 0, 0};
    at = put(at, encapsulation, 4);
    at = put_u32(at, (uint32_t)(stamp_ns / NS_PER_S));
    at = put_u32(at, (uint32_t)(stamp_ns % NS_PER_S));
    at = put_u32(at, (uint32_t)(source_ns / NS_PER_S));
    at = put_u32(at, (uint32_t)(source_ns % NS_PER_S));
    at = put_u64(at, size >= BODY_SIZE_AT ? __builtin_bswap64(record_u64(payload + TICKS_AT)) : 0);
    at = put_u8(at, (uint8_t)stream->direction);
    at = put(at, padding, 3);
    at = put(at, stream->same, (size_t)stream->same_size);
    return put_u32(at, (uint32_t)size);
}

/* (chunk, room, begin, end, streams, chunk_bytes) -> (end of the last row taken, rows, bytes, first and last stamp) */
static PyObject *add_rows(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 6 || !PyByteArray_CheckExact(args[0]) || !PyList_CheckExact(args[4])) {
        PyErr_SetString(PyExc_TypeError, "add_rows: found other arguments, expected those of chunk_rows.py");
        return NULL;
    }
    PyObject *chunk = args[0], *streams = args[4];
    const Py_ssize_t begin = PyLong_AsSsize_t(args[2]), end = PyLong_AsSsize_t(args[3]);
    const Py_ssize_t chunk_bytes = PyLong_AsSsize_t(args[5]);
    Py_buffer room;
    if (PyErr_Occurred() || PyObject_GetBuffer(args[1], &room, PyBUF_SIMPLE) < 0)
        return NULL;
    const uint8_t *rows = room.buf;
    Py_ssize_t place = begin, filled = PyByteArray_GET_SIZE(chunk);
    uint64_t taken = 0, bytes = 0, first = 0, last = 0;
    int failed = begin < 0 || end > room.len;
    while (!failed && end - place >= QUEUE_RECORD_BYTES && filled <= chunk_bytes) {
        uint64_t row[5];
        struct stream stream;
        memcpy(row, rows + place, QUEUE_RECORD_BYTES);
        const uint64_t size = row[1], stamp_ns = row[3], source_ns = row[4];
        if (row[0] >= (uint64_t)PyList_GET_SIZE(streams) || size >= QUEUE_LARGE_BYTES ||
            (uint64_t)(end - place) < queue_need(size) ||
            !get_stream(PyList_GET_ITEM(streams, (Py_ssize_t)row[0]), &stream))
            break;
        const int raw = stream.direction >= 0;
        if (raw && (stamp_ns >= STAMP_END || source_ns >= STAMP_END))
            break;
        const uint64_t content = MESSAGE_HEAD + size + (raw ? RAW_HEAD + (uint64_t)stream.same_size + 4 : 0);
        const uint8_t *payload = rows + place + QUEUE_RECORD_BYTES;
        if (PyByteArray_Resize(chunk, filled + RECORD_HEAD + (Py_ssize_t)content) < 0) {
            failed = 1;
            break;
        }
        uint8_t *at = (uint8_t *)PyByteArray_AS_STRING(chunk) + filled;
        at = put_u8(at, MESSAGE);
        at = put_u64(at, content);
        at = put_u16(at, stream.channel);
        at = put_u32(at, (uint32_t)row[2]);
        at = put_u64(at, stamp_ns);
        at = put_u64(at, source_ns ? source_ns : stamp_ns);
        if (raw)
            at = put_raw_head(at, &stream, row, payload);
        put(at, payload, size);
        filled += RECORD_HEAD + (Py_ssize_t)content;
        place += (Py_ssize_t)queue_need(size);
        bytes += size;
        first = taken ? first : stamp_ns;
        last = stamp_ns;
        taken++;
    }
    PyBuffer_Release(&room);
    if (failed && !PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "add_rows: found rows outside of the room");
    if (PyErr_Occurred())
        return NULL;
    return Py_BuildValue("nKKKK", place, (unsigned long long)taken, (unsigned long long)bytes,
                         (unsigned long long)first, (unsigned long long)last);
}

/* -- the index of a chunk ----------------------------------------------------------------------------------------- */

/* Place in ``channels`` plus 1, by channel; all 0 between two calls. */
static uint32_t numbers[1 << 16];

struct channel {
    uint16_t number;
    Py_ssize_t messages;
    Py_ssize_t at; /* of its index in the result */
    uint8_t *next;
};

/* The next record at ``*at`` that is a message; NULL behind the last one.  The last record may end behind the chunk. */
static const uint8_t *next_message(const uint8_t *chunk, Py_ssize_t size, Py_ssize_t *at)
{
    while (size - *at >= RECORD_HEAD + MESSAGE_HEAD) {
        const uint8_t *record = chunk + *at;
        const uint64_t length = record_u64(record + 1);
        *at = length > (uint64_t)(size - *at - RECORD_HEAD) ? size : *at + RECORD_HEAD + (Py_ssize_t)length;
        if (record[0] == MESSAGE)
            return record;
    }
    return NULL;
}

/* chunk -> (first and last time, message indexes, ((channel, place of its index, messages) …)) */
static PyObject *index_messages(PyObject *module, PyObject *data)
{
    (void)module;
    Py_buffer view;
    PyObject *result = NULL, *index = NULL, *rows = NULL;
    struct channel *channels = NULL;
    Py_ssize_t known = 0, room = 0, at = 0, size = 0;
    uint64_t first = UINT64_MAX, last = 0;
    const uint8_t *record;
    if (PyObject_GetBuffer(data, &view, PyBUF_SIMPLE) < 0)
        return NULL;
    while ((record = next_message(view.buf, view.len, &at))) {
        uint16_t number;
        memcpy(&number, record + RECORD_HEAD, 2);
        const uint64_t time = record_u64(record + RECORD_HEAD + INDEX_HEAD);
        first = time < first ? time : first;
        last = time > last ? time : last;
        if (!numbers[number]) {
            if (known == room) {
                room = room ? 2 * room : 32;
                struct channel *more = PyMem_Realloc(channels, (size_t)room * sizeof *channels);
                if (!more) {
                    PyErr_NoMemory();
                    goto done;
                }
                channels = more;
            }
            channels[known] = (struct channel){.number = number};
            numbers[number] = (uint32_t)++known;
        }
        channels[numbers[number] - 1].messages++;
    }
    for (Py_ssize_t i = 0; i < known; i++) {
        channels[i].at = size;
        size += RECORD_HEAD + INDEX_HEAD + PAIR * channels[i].messages;
    }
    index = PyBytes_FromStringAndSize(NULL, size);
    rows = PyTuple_New(known);
    if (!index || !rows)
        goto done;
    for (Py_ssize_t i = 0; i < known; i++) {
        struct channel *channel = &channels[i];
        uint8_t *place = (uint8_t *)PyBytes_AS_STRING(index) + channel->at;
        place = put_u8(place, MESSAGE_INDEX);
        place = put_u64(place, (uint64_t)(INDEX_HEAD + PAIR * channel->messages));
        place = put_u16(place, channel->number);
        channel->next = put_u32(place, (uint32_t)(PAIR * channel->messages));
        PyObject *row = Py_BuildValue("(inn)", channel->number, channel->at, channel->messages);
        if (!row)
            goto done;
        PyTuple_SET_ITEM(rows, i, row);
    }
    at = 0;
    while ((record = next_message(view.buf, view.len, &at))) {
        uint16_t number;
        memcpy(&number, record + RECORD_HEAD, 2);
        struct channel *channel = &channels[numbers[number] - 1];
        channel->next = put(channel->next, record + RECORD_HEAD + INDEX_HEAD, 8);
        channel->next = put_u64(channel->next, (uint64_t)(record - (const uint8_t *)view.buf));
    }
    result = Py_BuildValue("KKOO", (unsigned long long)(known ? first : 0), (unsigned long long)last, index, rows);
done:
    for (Py_ssize_t i = 0; i < known; i++)
        numbers[channels[i].number] = 0;
    PyMem_Free(channels);
    Py_XDECREF(index);
    Py_XDECREF(rows);
    PyBuffer_Release(&view);
    return result;
}

/* -- module ------------------------------------------------------------------------------------------------------- */

static PyMethodDef functions[] = {
    {"add_rows", (PyCFunction)(void (*)(void))add_rows, METH_FASTCALL, "See chunk_rows.py."},
    {"index_messages", index_messages, METH_O, "See chunk_rows.py."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_chunk", "See chunk_rows.py.", -1, functions,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__chunk(void)
{
    return PyModule_Create(&definition);
}
