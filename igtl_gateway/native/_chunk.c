/* The compiled part of igtl_gateway/record/sessionfile/chunk_rows.py, which documents the functions.
 *
 * index_messages also exists in Python, with an equal result.  add_rows and add_columns exist only here; what they leave
 * goes through SessionWriter.write, which makes the same bytes of it.  Rows are records of the recorder's queue: _queue.h has their
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

/* A message to be added. */
struct message {
    uint64_t number, stamp_ns, publish_ns, source_ns, size;
    const uint8_t *payload;
};

static uint8_t *put_raw_head(uint8_t *at, const struct stream *stream, const struct message *message)
{
    const uint64_t size = message->size, stamp_ns = message->stamp_ns, source_ns = message->source_ns;
    const uint8_t encapsulation[4] = {0, 1, 0, 0}, padding[3] = {0, 0, 0};
    at = put(at, encapsulation, 4);
    at = put_u32(at, (uint32_t)(stamp_ns / NS_PER_S));
    at = put_u32(at, (uint32_t)(stamp_ns % NS_PER_S));
    at = put_u32(at, (uint32_t)(source_ns / NS_PER_S));
    at = put_u32(at, (uint32_t)(source_ns % NS_PER_S));
    at = put_u64(at, size >= BODY_SIZE_AT ? __builtin_bswap64(record_u64(message->payload + TICKS_AT)) : 0);
    at = put_u8(at, (uint8_t)stream->direction);
    at = put(at, padding, 3);
    at = put(at, stream->same, (size_t)stream->same_size);
    return put_u32(at, (uint32_t)size);
}

/* Bytes of a message behind its MCAP fields. */
static uint64_t packed_size(const struct stream *stream, uint64_t size)
{
    return size + (stream->direction >= 0 ? RAW_HEAD + (uint64_t)stream->same_size + 4 : 0);
}

/* Whether the stamps of a message fit those of ROS, which only a RawMessage has. */
static int has_ros_stamps(const struct stream *stream, const struct message *message)
{
    return stream->direction < 0 || (message->stamp_ns < STAMP_END && message->source_ns < STAMP_END);
}

/* Add a message to the bytes of a chunk; 0: there is no memory. */
static int add_message(PyObject *chunk, Py_ssize_t *filled, const struct stream *stream, const struct message *message)
{
    const uint64_t content = MESSAGE_HEAD + packed_size(stream, message->size);
    if (PyByteArray_Resize(chunk, *filled + RECORD_HEAD + (Py_ssize_t)content) < 0)
        return 0;
    uint8_t *at = (uint8_t *)PyByteArray_AS_STRING(chunk) + *filled;
    at = put_u8(at, MESSAGE);
    at = put_u64(at, content);
    at = put_u16(at, stream->channel);
    at = put_u32(at, (uint32_t)message->number);
    at = put_u64(at, message->stamp_ns);
    at = put_u64(at, message->publish_ns);
    if (stream->direction >= 0)
        at = put_raw_head(at, stream, message);
    put(at, message->payload, message->size);
    *filled += RECORD_HEAD + (Py_ssize_t)content;
    return 1;
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
        const struct message message = {row[2],   stamp_ns, source_ns ? source_ns : stamp_ns,
                                        source_ns, size,     rows + place + QUEUE_RECORD_BYTES};
        if (row[0] >= (uint64_t)PyList_GET_SIZE(streams) || size >= QUEUE_LARGE_BYTES ||
            (uint64_t)(end - place) < queue_need(size) ||
            !get_stream(PyList_GET_ITEM(streams, (Py_ssize_t)row[0]), &stream) || !has_ros_stamps(&stream, &message))
            break;
        if (!add_message(chunk, &filled, &stream, &message)) {
            failed = 1;
            break;
        }
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

/* -- columns into a chunk ----------------------------------------------------------------------------------------- */

/* Places of the arguments of add_columns. */
enum { CHUNK, DATA, WHICH, IDENTS, NUMBERS, TIMES, PUBLISH, SOURCES, BEGINS, ENDS, FROM, STREAMS, FULL, LARGE, ARGUMENTS };

static const Py_ssize_t COLUMN_BYTES[ARGUMENTS] = {[WHICH] = 2,   [IDENTS] = 4,  [NUMBERS] = 8, [TIMES] = 8,
                                                   [PUBLISH] = 8, [SOURCES] = 8, [BEGINS] = 8,  [ENDS] = 8};

/* Hold the columns, which have one element per message; return how many are held. */
static int hold_columns(PyObject *const *args, Py_buffer *columns)
{
    int column = WHICH;
    for (; column <= ENDS; column++) {
        if (PyObject_GetBuffer(args[column], &columns[column], PyBUF_SIMPLE) < 0)
            break;
        if (columns[column].len != columns[WHICH].len / COLUMN_BYTES[WHICH] * COLUMN_BYTES[column]) {
            PyErr_SetString(PyExc_ValueError, "add_columns: found columns of other lengths");
            column++;
            break;
        }
    }
    return column;
}

/* (chunk, data, which, idents, numbers, times, publish_times, sources, begins, ends, row, streams, chunk_bytes, large)
 * -> row */
static PyObject *add_columns(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != ARGUMENTS || !PyByteArray_CheckExact(args[CHUNK]) || !PyTuple_CheckExact(args[DATA]) ||
        !PyList_CheckExact(args[STREAMS])) {
        PyErr_SetString(PyExc_TypeError, "add_columns: found other arguments, expected those of chunk_rows.py");
        return NULL;
    }
    PyObject *chunk = args[CHUNK], *streams = args[STREAMS], *parts = args[DATA];
    Py_ssize_t row = PyLong_AsSsize_t(args[FROM]), filled = PyByteArray_GET_SIZE(chunk);
    const Py_ssize_t chunk_bytes = PyLong_AsSsize_t(args[FULL]), large = PyLong_AsSsize_t(args[LARGE]);
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(parts); i++)
        if (!PyBytes_CheckExact(PyTuple_GET_ITEM(parts, i)))
            PyErr_SetString(PyExc_TypeError, "add_columns: expected bytes");
    if (PyErr_Occurred())
        return NULL;
    Py_buffer columns[ARGUMENTS];
    const int held = hold_columns(args, columns);
    const Py_ssize_t rows = PyErr_Occurred() ? 0 : columns[WHICH].len / COLUMN_BYTES[WHICH];
    while (row >= 0 && row < rows && filled <= chunk_bytes) {
        const uint16_t which = ((const uint16_t *)columns[WHICH].buf)[row];
        const int32_t ident = ((const int32_t *)columns[IDENTS].buf)[row];
        const int64_t begin = ((const int64_t *)columns[BEGINS].buf)[row], end = ((const int64_t *)columns[ENDS].buf)[row];
        struct stream stream;
        if (which >= PyTuple_GET_SIZE(parts) || begin < 0 || end < begin ||
            end > PyBytes_GET_SIZE(PyTuple_GET_ITEM(parts, which))) {
            PyErr_SetString(PyExc_ValueError, "add_columns: found a message outside of the data");
            break;
        }
        const struct message message = {
            ((const uint64_t *)columns[NUMBERS].buf)[row], ((const uint64_t *)columns[TIMES].buf)[row],
            ((const uint64_t *)columns[PUBLISH].buf)[row], ((const uint64_t *)columns[SOURCES].buf)[row],
            (uint64_t)(end - begin), (const uint8_t *)PyBytes_AS_STRING(PyTuple_GET_ITEM(parts, which)) + begin,
        };
        if (ident < 0 || ident >= PyList_GET_SIZE(streams) || !get_stream(PyList_GET_ITEM(streams, ident), &stream) ||
            !has_ros_stamps(&stream, &message) || packed_size(&stream, message.size) >= (uint64_t)large)
            break;
        if (!add_message(chunk, &filled, &stream, &message))
            break;
        row++;
    }
    for (int column = WHICH; column < held; column++)
        PyBuffer_Release(&columns[column]);
    return PyErr_Occurred() ? NULL : PyLong_FromSsize_t(row);
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
    {"add_columns", (PyCFunction)(void (*)(void))add_columns, METH_FASTCALL, "See chunk_rows.py."},
    {"index_messages", index_messages, METH_O, "See chunk_rows.py."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_chunk", "See chunk_rows.py.", -1, functions,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__chunk(void)
{
    return PyModule_Create(&definition);
}
