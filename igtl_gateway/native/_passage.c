/* The native passage: messages of compiled streams, from the socket or the DDS reader to the other side, without the GIL.
 *
 * igtl_gateway/native/passage/__init__.py documents what it is for; passage/STATES.md has the states of a large message and
 * of a subscription.  Everything here is optional: a message that is not as its stream expects goes to Python, which has
 * the same streams, and gives the same entries.
 *
 * This file makes a module of the rooms below passage/, as one unit, so that what a message passes is inlined.
 */
#include "passage/python/_passage.h"

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "_passage", "See igtl_gateway.native.passage.", -1, NULL,
                                        NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__passage(void)
{
    begin_bytes();
    begin_bulk(1);
    if (begin_take())
        return NULL;
    PyObject *module = PyModule_Create(&definition);
    PyTypeObject *types[] = {&Lock_Type,         &Passage_Type,   &Link_Type,  &Subscription_Type,
                             &Publisher_Type, &Stream_Type, &Guard_Type};
    const char *names[] = {"Lock", "Passage", "Link", "Subscription", "Publisher", "Stream", "Guard"};
    for (size_t i = 0; module && i < sizeof types / sizeof *types; i++)
        if (PyType_Ready(types[i]) || PyModule_AddObjectRef(module, names[i], (PyObject *)types[i]))
            Py_CLEAR(module);
    return module;
}
