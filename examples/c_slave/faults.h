/* Mistakes that can be built in on purpose, to see whether a test finds them: make FAULT=NAME.
 *
 * Each is a slip of one or two lines that firmware really has. Without FAULT the compiler removes
 * every trace of them; who copies this code leaves the file and the PLANTED conditions out. */
#ifndef FAULTS_H
#define FAULTS_H

enum fault {
    FAULT_NONE,

    /* AL state machine */
    FAULT_AL_CODE_FORGOTTEN,        /* the error indication is set without an AL status code */
    FAULT_AL_ERROR_NOT_LATCHED,     /* a request is executed although an error is not acknowledged */
    FAULT_AL_UNKNOWN_STATE,         /* a value that is no state gets the code of a wrong transition */
    FAULT_AL_MAILBOX_UNCHECKED,     /* PREOP is entered with whatever mailbox settings there are */

    /* mailbox */
    FAULT_MAILBOX_COUNTER_IGNORED,  /* a duplicate is served again */
    FAULT_MAILBOX_LENGTH_UNCHECKED, /* the length in the header is believed */
    FAULT_MAILBOX_COUNTER_STUCK,    /* every reply has the same counter */
    FAULT_REPEAT_UNACKNOWLEDGED,    /* a message is repeated, the acknowledge bit forgotten */

    /* SDO */
    FAULT_SDO_SIZE_UNCHECKED,       /* a value that is too short is taken */
    FAULT_SDO_WRONG_ABORT,          /* a missing subindex is reported as a missing object */
    FAULT_SDO_RANGE_ONE_SIDED,      /* only the upper limit of a value is checked */
    FAULT_SDO_STATE_UNCHECKED,      /* rights that depend on the AL state are ignored */

    /* segments */
    FAULT_SEGMENT_TOGGLE_UNCHECKED, /* a segment of a download is taken with any toggle bit */
    FAULT_SEGMENT_LAST_TOO_EARLY,   /* a download may end before all announced bytes came */
    FAULT_SEGMENT_LAST_FORGOTTEN,   /* the last segment of an upload does not say so */

    /* process data */
    FAULT_WATCHDOG_IGNORED,         /* outputs may stay away for ever */
    FAULT_OUTPUTS_IN_SAFEOP,        /* outputs act before OP */
    FAULT_PDO_LENGTH_UNCHECKED,     /* SyncManagers of any length are taken */

    /* CiA 402 */
    FAULT_RESET_BY_LEVEL,           /* fault reset works by its level, not by its edge */
    FAULT_QUICK_STOP_IGNORED,       /* quick stop has no effect while the drive is enabled */

    FAULT_ALL                       /* all of them at once */
};

#ifndef FAULT
#define FAULT FAULT_NONE
#endif

#define PLANTED(name) (FAULT == FAULT_ALL || FAULT == FAULT_##name)

#endif
