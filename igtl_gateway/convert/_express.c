/* The compiled part of igtl_gateway/convert/express.py, which documents the functions.
 *
 * The functions for poses also exist in Python, with results that are equal bit for bit.  Those for bulk (strings,
 * points, clouds, images) exist only here.  For every message that is not as the sample they return None, and the full
 * path handles it.  Arithmetic for poses is that of _poses.h; that for many points is single precision as in scaling.py.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "_poses.h"

/* -- poses ------------------------------------------------------------------------------------------------------------- */

static int all_tuples(PyObject *forms)
{
    if (!PyTuple_Check(forms))
        return 0;
    for (Py_ssize_t i = 0; i < PyTuple_GET_SIZE(forms); i++)
        if (!PyTuple_Check(PyTuple_GET_ITEM(forms, i)))
            return 0;
    return 1;
}

static PyObject *pose_to_ros(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[7]) || !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError, "pose_to_ros(data, sample, at, bytes, check_crc, own, received_ns, (times, by), forms)");
        return NULL;
    }
    if (!PyBytes_Check(args[0]))
        Py_RETURN_NONE;
    const uint8_t *data = (const uint8_t *)PyBytes_AS_STRING(args[0]);
    const uint8_t *sample = (const uint8_t *)PyBytes_AS_STRING(args[1]);
    Py_ssize_t size = PyBytes_GET_SIZE(args[0]);
    Py_ssize_t at = PyLong_AsSsize_t(args[2]), bytes = PyLong_AsSsize_t(args[3]);
    int check_crc = PyObject_IsTrue(args[4]), own = PyObject_IsTrue(args[5]);
    int64_t received_ns = PyLong_AsLongLong(args[6]);
    double times, by;
    if (PyErr_Occurred() || !PyArg_ParseTuple(args[7], "dd", &times, &by))
        return NULL;
    if (at < HEADER_SIZE || (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES) ||
        at + bytes > PyBytes_GET_SIZE(args[1])) {
        PyErr_SetString(PyExc_ValueError, "pose_to_ros: numbers outside the sample");
        return NULL;
    }
    struct igtl_poses stream = {sample, PyBytes_GET_SIZE(args[1]), at, bytes, check_crc, times, by};
    double pose[7];
    if (!pose_from_igtl(&stream, data, size, pose))
        Py_RETURN_NONE;
    int64_t source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    int64_t stamp_ns = own && source_ns > 0 ? source_ns : received_ns;
    Py_ssize_t forms = PyTuple_GET_SIZE(args[8]);
    PyObject *result = PyTuple_New(2 + forms);
    if (!result)
        return NULL;
    PyTuple_SET_ITEM(result, 0, PyLong_FromLongLong(source_ns));
    PyTuple_SET_ITEM(result, 1, PyLong_FromLongLong(stamp_ns));
    for (Py_ssize_t i = 0; i < forms; i++) {
        PyObject *form = PyTuple_GET_ITEM(args[8], i), *template;
        Py_ssize_t stamp_at;
        if (!PyArg_ParseTuple(form, "Sn", &template, &stamp_at)) {
            Py_DECREF(result);
            return NULL;
        }
        Py_ssize_t length = PyBytes_GET_SIZE(template);
        if (length < POSE_BYTES + stamp_at + 8 || stamp_at < 0) {
            PyErr_SetString(PyExc_ValueError, "pose_to_ros: a form without room for stamp and pose");
            Py_DECREF(result);
            return NULL;
        }
        PyObject *cdr = PyBytes_FromStringAndSize(PyBytes_AS_STRING(template), length);
        if (!cdr) {
            Py_DECREF(result);
            return NULL;
        }
        put_ros_pose((uint8_t *)PyBytes_AS_STRING(cdr), length, stamp_at, stamp_ns, pose);
        PyTuple_SET_ITEM(result, 2 + i, cdr);
    }
    return result;
}

static PyObject *pose_to_igtl(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[2]) || !PyTuple_Check(args[7]) ||
        !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError,
                        "pose_to_igtl(cdr, sample, names, bytes, own, source_ns, received_ns, (times, by), forms)");
        return NULL;
    }
    double times, by;
    Py_ssize_t first_end, second, end, bytes = PyLong_AsSsize_t(args[3]);
    if (!PyArg_ParseTuple(args[7], "dd", &times, &by) || !PyArg_ParseTuple(args[2], "nnn", &first_end, &second, &end))
        return NULL;
    int own = PyObject_IsTrue(args[4]);
    int64_t source_ns = PyLong_AsLongLong(args[5]), received_ns = PyLong_AsLongLong(args[6]);
    if (PyErr_Occurred())
        return NULL;
    Py_ssize_t size = PyBytes_GET_SIZE(args[1]);
    if (first_end < NAMES_AT || second < first_end || end < second || end > size - POSE_BYTES ||
        (bytes != MATRIX_BYTES && bytes != QUATERNION_BYTES)) {
        PyErr_SetString(PyExc_ValueError, "pose_to_igtl: names outside the sample");
        return NULL;
    }
    if (!PyBytes_Check(args[0]))
        Py_RETURN_NONE;
    struct ros_poses stream = {(const uint8_t *)PyBytes_AS_STRING(args[1]), size, first_end, second, end, bytes, times, by};
    int64_t header_ns;
    double numbers[12];
    if (!pose_from_ros(&stream, (const uint8_t *)PyBytes_AS_STRING(args[0]), PyBytes_GET_SIZE(args[0]), &header_ns, numbers))
        Py_RETURN_NONE;
    int64_t said_ns = header_ns ? header_ns : source_ns;
    int64_t stamp_ns = own && said_ns > 0 ? said_ns : received_ns;
    Py_ssize_t forms = PyTuple_GET_SIZE(args[8]);
    PyObject *result = PyTuple_New(1 + forms);
    if (!result)
        return NULL;
    PyTuple_SET_ITEM(result, 0, PyLong_FromLongLong(stamp_ns));
    for (Py_ssize_t i = 0; i < forms; i++) {
        PyObject *form = PyTuple_GET_ITEM(args[8], i), *template;
        Py_ssize_t at, digits_at;
        if (!PyArg_ParseTuple(form, "Snn", &template, &at, &digits_at)) {
            Py_DECREF(result);
            return NULL;
        }
        Py_ssize_t length = PyBytes_GET_SIZE(template);
        if (at < HEADER_SIZE || at + bytes > length || digits_at + STAMP_DIGITS > length) {
            PyErr_SetString(PyExc_ValueError, "pose_to_igtl: a form without room for the numbers");
            Py_DECREF(result);
            return NULL;
        }
        if (!fits_digits(digits_at, header_ns)) {
            Py_DECREF(result); /* metadata of another size than in the template */
            Py_RETURN_NONE;
        }
        PyObject *message = PyBytes_FromStringAndSize(PyBytes_AS_STRING(template), length);
        if (!message) {
            Py_DECREF(result);
            return NULL;
        }
        uint8_t *out = (uint8_t *)PyBytes_AS_STRING(message);
        put_u64(out + TICKS_AT, ns_to_ticks(stamp_ns));
        put_igtl_pose(out, length, at, bytes, digits_at, numbers, header_ns);
        PyTuple_SET_ITEM(result, 1 + i, message);
    }
    return result;
}

/* -- bulk: strings, points, clouds, pictures --------------------------------------------------------------------------- */

/* The conversions of bulk messages; the same numbers as in express.py. */
enum { TEXT = 0, POINT = 1, POINTS = 2, CLOUD = 3, PICTURE = 4, BLUE_FIRST = 5 };

#define POINT_BYTES 136 /* name 64, group 32, rgba 4, position 12, diameter 4, owner 20 */
#define GROUP_AT 64
#define RGBA_AT 96
#define POSITION_AT 100
#define OWNER_AT 116
#define POLYDATA_HEAD 40
#define ROW_OF_POINTS 20 /* x, y, z, rgba, diameter */
#define ROW_OF_CLOUD 12
#define WHITE 0xFFFFFFFFu
#define MAX_TEXT 65535
#define MIB_ASCII 3

static uint32_t get_u32_ros(const uint8_t *at)
{
    uint32_t word;
    memcpy(&word, at, 4);
    return word;
}

static void put_u32_ros(uint8_t *at, uint32_t word) { memcpy(at, &word, 4); }

/* Scale a length in single precision, with one rounding: one of the two factors is 1. */
static float scaled(uint32_t word, float times, float by) { return float_of(word) * times / by; }

/* Return whether a float is NaN or infinity: all bits of its exponent are set. */
static uint32_t not_finite(uint32_t word) { return (word & 0x7F800000u) == 0x7F800000u; }

/* Return whether the bytes are ASCII without NUL, which all encodings of STRING have in common. */
static int plain_text(const uint8_t *text, Py_ssize_t size)
{
    for (Py_ssize_t i = 0; i < size; i++)
        if (text[i] == 0 || text[i] > 127)
            return 0;
    return 1;
}

static int ascii_compatible(uint32_t encoding)
{
    return encoding == MIB_ASCII || encoding == 4 || encoding == 106 || encoding == 2252;
}

/* Return the number of points of a content; -1: the content cannot be converted to this form. */
static Py_ssize_t points_in(int form, const uint8_t *content, Py_ssize_t size)
{
    if (form == CLOUD) {
        if (size < POLYDATA_HEAD)
            return -1;
        uint64_t count = get_u32(content), cells = get_u32(content + 4), cells_size = get_u32(content + 8);
        for (int word = 3; word < 10; word++) /* lines, polygons, strips, attributes */
            if (get_u32(content + 4 * word))
                return -1;
        if (!count || (uint64_t)size != POLYDATA_HEAD + 12 * count + cells_size)
            return -1;
        if (!cells)
            return cells_size ? -1 : (Py_ssize_t)count;
        if (cells != 1 || cells_size != 4 * (count + 1))
            return -1;
        const uint8_t *cell = content + POLYDATA_HEAD + 12 * count;
        uint32_t odd = get_u32(cell) ^ (uint32_t)count;
        for (uint32_t i = 0; i < count; i++)
            odd |= get_u32(cell + 4 + 4 * (size_t)i) ^ i;
        return odd ? -1 : (Py_ssize_t)count;
    }
    return size && size % POINT_BYTES == 0 ? size / POINT_BYTES : -1;
}

/* First bytes of name, group and owner.  If one is not 0, a list with labels is published, too. */
static uint32_t labels_of(const uint8_t *one) { return one[0] | one[GROUP_AT] | one[OWNER_AT]; }

/* Build a PointCloud2 from a template that ends before its data; NULL without an exception: a label, NaN or infinity
 * needs the full path. */
static PyObject *cloud_message(int form, const uint8_t *content, Py_ssize_t count, PyObject *template,
                               Py_ssize_t width_at, float times, float by)
{
    Py_ssize_t head = PyBytes_GET_SIZE(template), step = form == CLOUD ? ROW_OF_CLOUD : ROW_OF_POINTS;
    if ((uint64_t)count * step > UINT32_MAX)
        return NULL;
    PyObject *cdr = PyBytes_FromStringAndSize(NULL, head + count * step + 1);
    if (!cdr)
        return NULL;
    uint8_t *out = (uint8_t *)PyBytes_AS_STRING(cdr), *row = out + head;
    memcpy(out, PyBytes_AS_STRING(template), head);
    put_u32_ros(out + width_at, (uint32_t)count);
    put_u32_ros(out + head - 8, (uint32_t)(count * step));
    put_u32_ros(out + head - 4, (uint32_t)(count * step));
    uint32_t odd = 0;
    if (form == CLOUD) {
        const uint8_t *from = content + POLYDATA_HEAD;
        for (Py_ssize_t i = 0; i < 3 * count; i++) {
            uint32_t word = word_of(scaled(get_u32(from + 4 * i), times, by));
            odd |= not_finite(word);
            put_u32_ros(row + 4 * i, word);
        }
    } else {
        for (const uint8_t *one = content; row < out + head + count * step; one += POINT_BYTES, row += step) {
            for (int axis = 0; axis < 3; axis++) {
                uint32_t word = word_of(scaled(get_u32(one + POSITION_AT + 4 * axis), times, by));
                odd |= not_finite(word);
                put_u32_ros(row + 4 * axis, word);
            }
            uint32_t rgba = get_u32(one + RGBA_AT), diameter = word_of(scaled(get_u32(one + POSITION_AT + 12), times, by));
            odd |= not_finite(diameter) | labels_of(one);
            put_u32_ros(row + 12, rgba << 24 | rgba >> 8);
            put_u32_ros(row + 16, diameter);
        }
    }
    out[head + count * step] = 1; /* is_dense */
    if (odd) {
        Py_DECREF(cdr);
        return NULL;
    }
    return cdr;
}

/* Build a PointStamped from the only point; NULL without an exception as above. */
static PyObject *point_message(const uint8_t *content, PyObject *template, double times, double by)
{
    double place[3];
    if (labels_of(content))
        return NULL;
    for (int axis = 0; axis < 3; axis++) {
        double value = get_f32(content + POSITION_AT + 4 * axis);
        if (!isfinite(value))
            return NULL;
        place[axis] = value * times / by;
    }
    Py_ssize_t size = PyBytes_GET_SIZE(template);
    PyObject *cdr = PyBytes_FromStringAndSize(PyBytes_AS_STRING(template), size);
    if (cdr)
        memcpy(PyBytes_AS_STRING(cdr) + size - sizeof place, place, sizeof place);
    return cdr;
}

/* Build a String; NULL without an exception: the text needs the full path. */
static PyObject *text_message(const uint8_t *content, Py_ssize_t size)
{
    if (size < 4)
        return NULL;
    uint32_t head = get_u32(content), length = head & 0xFFFF;
    if (size != 4 + (Py_ssize_t)length || !ascii_compatible(head >> 16) || !plain_text(content + 4, length))
        return NULL;
    PyObject *cdr = PyBytes_FromStringAndSize(NULL, 8 + (Py_ssize_t)length + 1);
    if (!cdr)
        return NULL;
    uint8_t *out = (uint8_t *)PyBytes_AS_STRING(cdr);
    memcpy(out, "\0\1\0\0", 4);
    put_u32_ros(out + 4, length + 1);
    memcpy(out + 8, content + 4, length);
    out[8 + length] = 0;
    return cdr;
}

/* Build an Image of the same size as the last one. */
static PyObject *picture_message(const uint8_t *content, Py_ssize_t size, PyObject *template)
{
    Py_ssize_t head = PyBytes_GET_SIZE(template);
    const char *before = PyBytes_AS_STRING(template);
    if (size != (Py_ssize_t)get_u32_ros((const uint8_t *)before + head - 4))
        return NULL;
    PyObject *cdr = PyBytes_FromStringAndSize(NULL, head + size);
    if (cdr) {
        memcpy(PyBytes_AS_STRING(cdr), before, head);
        memcpy(PyBytes_AS_STRING(cdr) + head, content, size);
    }
    return cdr;
}

/* Build one form of a content: a new reference; NULL without an exception: the message needs the full path. */
static PyObject *form_of(int form, const uint8_t *content, Py_ssize_t size, PyObject *template, Py_ssize_t stamp_at,
                         Py_ssize_t width_at, int64_t stamp_ns, double times, double by)
{
    PyObject *cdr;
    if (form == TEXT) {
        cdr = text_message(content, size);
    } else if (form == PICTURE) {
        cdr = picture_message(content, size, template);
    } else {
        Py_ssize_t count = points_in(form, content, size);
        if (count < 0)
            return NULL;
        if (form == POINT && count > 1)
            Py_RETURN_NONE; /* the row does not apply */
        cdr = form == POINT ? point_message(content, template, times, by)
                            : cloud_message(form, content, count, template, width_at, (float)times, (float)by);
    }
    if (cdr && stamp_at)
        put_ros_stamp((uint8_t *)PyBytes_AS_STRING(cdr) + stamp_at, stamp_ns);
    return cdr;
}

static PyObject *bulk_to_ros(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[7]) || !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError,
                        "bulk_to_ros(data, sample, at, tail, check_crc, own, received_ns, (times, by), forms)");
        return NULL;
    }
    const uint8_t *sample = (const uint8_t *)PyBytes_AS_STRING(args[1]);
    Py_ssize_t at = PyLong_AsSsize_t(args[2]), tail = PyLong_AsSsize_t(args[3]);
    int check_crc = PyObject_IsTrue(args[4]), own = PyObject_IsTrue(args[5]);
    int64_t received_ns = PyLong_AsLongLong(args[6]);
    double times, by;
    if (PyErr_Occurred() || !PyArg_ParseTuple(args[7], "dd", &times, &by))
        return NULL;
    if (tail < 0 || at + tail != PyBytes_GET_SIZE(args[1]) || at < HEADER_SIZE + (sample[1] == 2 ? EXTENDED_SIZE : 0)) {
        PyErr_SetString(PyExc_ValueError, "bulk_to_ros: a sample that is not all but the content");
        return NULL;
    }
    Py_buffer view;
    if (PyObject_GetBuffer(args[0], &view, PyBUF_SIMPLE))
        return NULL;
    const uint8_t *data = view.buf;
    Py_ssize_t size = view.len;
    PyObject *result = NULL;
    if (size < at + tail || !equal(data, sample, 0, TICKS_AT) || get_u64(data + BODY_SIZE_AT) != (uint64_t)(size - HEADER_SIZE))
        goto general;
    Py_ssize_t extended = sample[1] == 2 ? EXTENDED_SIZE : 0; /* its last 4 bytes are the message id */
    if (extended && !equal(data, sample, HEADER_SIZE, HEADER_SIZE + EXTENDED_SIZE - 4))
        goto general;
    if (!equal(data, sample, HEADER_SIZE + extended, at) || memcmp(data + size - tail, sample + at, (size_t)tail))
        goto general;
    if (check_crc && crc64(data + HEADER_SIZE, size - HEADER_SIZE) != get_u64(data + CRC_AT))
        goto general;
    int64_t source_ns = ticks_to_ns(get_u64(data + TICKS_AT));
    int64_t stamp_ns = own && source_ns > 0 ? source_ns : received_ns;
    Py_ssize_t forms = PyTuple_GET_SIZE(args[8]);
    if (!(result = PyTuple_New(2 + forms)))
        goto done;
    PyTuple_SET_ITEM(result, 0, PyLong_FromLongLong(source_ns));
    PyTuple_SET_ITEM(result, 1, PyLong_FromLongLong(stamp_ns));
    for (Py_ssize_t i = 0; i < forms; i++) {
        PyObject *template, *cdr = NULL;
        Py_ssize_t stamp_at, width_at;
        int form;
        if (PyArg_ParseTuple(PyTuple_GET_ITEM(args[8], i), "iSnn", &form, &template, &stamp_at, &width_at)) {
            Py_ssize_t room = PyBytes_GET_SIZE(template);
            if (form < TEXT || form > PICTURE || stamp_at < 0 || width_at < 0 ||
                (form != TEXT && (room < 32 || stamp_at + 8 > room || width_at + 4 > room)))
                PyErr_SetString(PyExc_ValueError, "bulk_to_ros: a form without room for stamp and width");
            else
                cdr = form_of(form, data + at, size - at - tail, template, stamp_at, width_at, stamp_ns, times, by);
        }
        if (!cdr) {
            Py_CLEAR(result);
            if (PyErr_Occurred())
                goto done;
            goto general;
        }
        PyTuple_SET_ITEM(result, 2 + i, cdr);
    }
    goto done;
general:
    result = Py_NewRef(Py_None);
done:
    PyBuffer_Release(&view);
    return result;
}

/* The values to read from a ROS message. */
struct source {
    const uint8_t *data;  /* the text, or the first point or pixel */
    Py_ssize_t count;     /* its size in bytes, or the number of points */
    Py_ssize_t step, x, y, z;
    float times, by;
};

static Py_ssize_t content_size(int form, Py_ssize_t count)
{
    if (form == TEXT)
        return 4 + count;
    if (form >= PICTURE)
        return count;
    return form == CLOUD ? POLYDATA_HEAD + 12 * count + 4 * (count + 1) : POINT_BYTES * count;
}

/* Write positions into rows; 0: NaN or infinity. */
static int put_positions(const struct source *from, uint8_t *row, Py_ssize_t row_size)
{
    uint32_t odd = 0;
    const uint8_t *one = from->data;
    for (Py_ssize_t i = 0; i < from->count; i++, one += from->step, row += row_size) {
        uint32_t x = word_of(scaled(get_u32_ros(one + from->x), from->times, from->by));
        uint32_t y = word_of(scaled(get_u32_ros(one + from->y), from->times, from->by));
        uint32_t z = word_of(scaled(get_u32_ros(one + from->z), from->times, from->by));
        odd |= not_finite(x) | not_finite(y) | not_finite(z);
        put_u32(row, x);
        put_u32(row + 4, y);
        put_u32(row + 8, z);
    }
    return !odd;
}

static int put_content(int form, const struct source *from, uint8_t *out)
{
    if (form == TEXT) {
        put_u32(out, (uint32_t)MIB_ASCII << 16 | (uint32_t)from->count);
        memcpy(out + 4, from->data, from->count);
        return 1;
    }
    if (form == PICTURE) {
        memcpy(out, from->data, from->count);
        return 1;
    }
    if (form == BLUE_FIRST) {
        for (Py_ssize_t i = 0; i + 3 <= from->count; i += 3) {
            out[i] = from->data[i + 2];
            out[i + 1] = from->data[i + 1];
            out[i + 2] = from->data[i];
        }
        return 1;
    }
    if (form == POINTS) {
        memset(out, 0, POINT_BYTES * from->count);
        for (Py_ssize_t i = 0; i < from->count; i++)
            put_u32(out + POINT_BYTES * i + RGBA_AT, WHITE);
        return put_positions(from, out + POSITION_AT, POINT_BYTES);
    }
    memset(out, 0, POLYDATA_HEAD);
    put_u32(out, (uint32_t)from->count);
    put_u32(out + 4, 1);
    put_u32(out + 8, (uint32_t)(4 * (from->count + 1)));
    uint8_t *cell = out + POLYDATA_HEAD + 12 * from->count;
    put_u32(cell, (uint32_t)from->count);
    for (Py_ssize_t i = 0; i < from->count; i++)
        put_u32(cell + 4 + 4 * i, (uint32_t)i);
    return put_positions(from, out + POLYDATA_HEAD, 12);
}

/* Find the text of a String; 0: the message needs the full path. */
static int text_in(const uint8_t *cdr, Py_ssize_t size, struct source *found)
{
    if (size < 8)
        return 0;
    Py_ssize_t length = get_u32_ros(cdr + 4);
    if (length > size - 8)
        return 0;
    while (length && !cdr[8 + length - 1])
        length--;
    found->data = cdr + 8;
    found->count = length;
    return length <= MAX_TEXT && plain_text(cdr + 8, length);
}

/* Find the points of a cloud; 0: the message needs the full path. */
static int cloud_in(const uint8_t *cdr, Py_ssize_t size, Py_ssize_t height_at, Py_ssize_t data_at, struct source *found)
{
    if (size < data_at + 1)
        return 0;
    uint64_t height = get_u32_ros(cdr + height_at), width = get_u32_ros(cdr + height_at + 4);
    uint64_t row = get_u32_ros(cdr + data_at - 8), length = get_u32_ros(cdr + data_at - 4);
    if (length + 1 > (uint64_t)(size - data_at) || (height != 1 && row != width * (uint64_t)found->step))
        return 0;
    if (!height || !width || height > length || width > length || height * width > length / (uint64_t)found->step)
        return 0;
    found->data = cdr + data_at;
    found->count = (Py_ssize_t)(height * width);
    return 1;
}

static PyObject *bulk_to_igtl(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    if (count != 9 || !PyBytes_Check(args[1]) || !PyTuple_Check(args[2]) || !PyTuple_Check(args[7]) ||
        !all_tuples(args[8])) {
        PyErr_SetString(PyExc_TypeError,
                        "bulk_to_igtl(cdr, sample, places, form, own, source_ns, received_ns, (times, by), forms)");
        return NULL;
    }
    struct source found = {0};
    double times, by;
    int form = (int)PyLong_AsLong(args[3]), own = PyObject_IsTrue(args[4]);
    int64_t source_ns = PyLong_AsLongLong(args[5]), received_ns = PyLong_AsLongLong(args[6]), header_ns = 0;
    Py_ssize_t height_at = 0, data_at = 0, places = PyTuple_GET_SIZE(args[2]);
    if (PyErr_Occurred() || !PyArg_ParseTuple(args[7], "dd", &times, &by))
        return NULL;
    found.times = (float)times, found.by = (float)by;
    Py_buffer view;
    if (PyObject_GetBuffer(args[0], &view, PyBUF_SIMPLE))
        return NULL;
    const uint8_t *cdr = view.buf, *sample = (const uint8_t *)PyBytes_AS_STRING(args[1]);
    Py_ssize_t size = view.len, same = PyBytes_GET_SIZE(args[1]);
    PyObject *result = NULL;
    if (size < same || same < 4 || !equal(cdr, sample, 0, 4))
        goto general;
    if (form == TEXT) {
        if (!text_in(cdr, size, &found))
            goto general;
    } else {
        Py_ssize_t *numbers[] = {&height_at, &data_at, &found.step, &found.x, &found.y, &found.z};
        if (places < 6 || places % 2) {
            PyErr_SetString(PyExc_ValueError, "bulk_to_igtl: invalid places");
            goto done;
        }
        for (int i = 0; i < 6; i++)
            *numbers[i] = PyLong_AsSsize_t(PyTuple_GET_ITEM(args[2], i));
        for (Py_ssize_t i = 6; i < places; i += 2) {
            Py_ssize_t begin = PyLong_AsSsize_t(PyTuple_GET_ITEM(args[2], i));
            Py_ssize_t end = PyLong_AsSsize_t(PyTuple_GET_ITEM(args[2], i + 1));
            if (begin < 0 || end < begin || end > same) {
                PyErr_SetString(PyExc_ValueError, "bulk_to_igtl: places outside the sample");
                goto done;
            }
            if (!equal(cdr, sample, begin, end))
                goto general;
        }
        if (height_at < 12 || data_at > same || data_at < height_at + 16 || found.x < 0 || found.y < 0 || found.z < 0 ||
            found.x + 4 > found.step || found.y + 4 > found.step || found.z + 4 > found.step) {
            PyErr_SetString(PyExc_ValueError, "bulk_to_igtl: places outside the sample");
            goto done;
        }
        if (form >= PICTURE) {
            found.data = cdr + data_at, found.count = found.step;
            if (size - data_at < found.count)
                goto general;
        } else if (!cloud_in(cdr, size, height_at, data_at, &found)) {
            goto general;
        }
        int32_t seconds;
        memcpy(&seconds, cdr + 4, 4);
        header_ns = seconds * NS_PER_S + get_u32_ros(cdr + 8);
    }
    int64_t said_ns = header_ns ? header_ns : source_ns;
    int64_t stamp_ns = own && said_ns > 0 ? said_ns : received_ns;
    Py_ssize_t forms = PyTuple_GET_SIZE(args[8]), content = content_size(form, found.count);
    if (content > UINT32_MAX)
        goto general;
    if (!(result = PyTuple_New(1 + forms)))
        goto done;
    PyTuple_SET_ITEM(result, 0, PyLong_FromLongLong(stamp_ns));
    const uint8_t *made = NULL; /* the content, when it has been built */
    for (Py_ssize_t i = 0; i < forms; i++) {
        PyObject *head, *tail;
        Py_ssize_t digits_at;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(args[8], i), "SSn", &head, &tail, &digits_at))
            goto failed;
        Py_ssize_t at = PyBytes_GET_SIZE(head), rest = PyBytes_GET_SIZE(tail);
        if (at < HEADER_SIZE || digits_at + STAMP_DIGITS > rest + (digits_at > 0 ? 0 : STAMP_DIGITS)) {
            PyErr_SetString(PyExc_ValueError, "bulk_to_igtl: a form without room for header or stamp");
            goto failed;
        }
        if (!fits_digits(digits_at, header_ns)) {
            Py_CLEAR(result); /* metadata of another size than in the template */
            goto general;
        }
        PyObject *message = PyBytes_FromStringAndSize(NULL, at + content + rest);
        if (!message)
            goto failed;
        PyTuple_SET_ITEM(result, 1 + i, message);
        uint8_t *out = (uint8_t *)PyBytes_AS_STRING(message);
        memcpy(out, PyBytes_AS_STRING(head), at);
        if (made) {
            memcpy(out + at, made, content);
        } else if (!put_content(form, &found, out + at)) {
            Py_CLEAR(result);
            goto general;
        }
        made = out + at;
        uint8_t *end = out + at + content;
        memcpy(end, PyBytes_AS_STRING(tail), rest);
        put_u64(out + TICKS_AT, ns_to_ticks(stamp_ns));
        put_u64(out + BODY_SIZE_AT, (uint64_t)(at + content + rest - HEADER_SIZE));
        if (digits_at > 0)
            put_digits(end + digits_at, header_ns);
        put_u64(out + CRC_AT, crc64(out + HEADER_SIZE, at + content + rest - HEADER_SIZE));
    }
    goto done;
failed:
    Py_CLEAR(result);
    goto done;
general:
    result = Py_NewRef(Py_None);
done:
    PyBuffer_Release(&view);
    return result;
}

/* -- CRC, for the tests ----------------------------------------------------------------------------------------------- */

/* (data, crc of the bytes before) -> CRC, as the processor allows and with the tables */
static PyObject *crc64_both(PyObject *module, PyObject *args)
{
    (void)module;
    Py_buffer view;
    unsigned long long crc;
    if (!PyArg_ParseTuple(args, "y*K", &view, &crc))
        return NULL;
    PyObject *both = Py_BuildValue("KK", (unsigned long long)crc64_update(crc, view.buf, view.len),
                                   (unsigned long long)crc64_portable(crc, view.buf, view.len));
    PyBuffer_Release(&view);
    return both;
}

/* -- module --------------------------------------------------------------------------------------------------------- */

static PyMethodDef functions[] = {
    {"pose_to_ros", (PyCFunction)(void (*)(void))pose_to_ros, METH_FASTCALL, "See express.py."},
    {"pose_to_igtl", (PyCFunction)(void (*)(void))pose_to_igtl, METH_FASTCALL, "See express.py."},
    {"bulk_to_ros", (PyCFunction)(void (*)(void))bulk_to_ros, METH_FASTCALL, "See express.py."},
    {"bulk_to_igtl", (PyCFunction)(void (*)(void))bulk_to_igtl, METH_FASTCALL, "See express.py."},
    {"crc64_both", crc64_both, METH_VARARGS, "(data, crc) -> (CRC, CRC with the tables), for the tests"},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_express", "See express.py.", -1, functions,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__express(void)
{
    begin_bytes();
    return PyModule_Create(&definition);
}
